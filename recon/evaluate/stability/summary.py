"""The trials counted: how often a wrong scene was published, how often a right one refused."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from splatnode.recon.evaluate.stability.case import Demand
from splatnode.recon.evaluate.stability.outcome import Outcome

_Z95 = 1.959963984540054  # normal quantile of a two-sided 95 % interval


@dataclass(frozen=True)
class Rate:
    """`count` of `of`, with the 95 % interval of the rate after Wilson (1927); None where nothing was tried."""

    count: int
    of: int
    rate: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Summary:
    """The counts and rates of one method. `confusion` counts outcomes by what was asked."""

    method: str
    trials: int
    confusion: Mapping[str, Mapping[str, int]]
    false_accept: Rate  # wrong scenes that were published, of all trials
    wrong_of_published: Rate  # the same, of the scenes that were published
    false_refuse: Rate  # no scene, of the trials that are enough for one
    other_code: Rate  # refusals for a reason that does not fit, of the refusals that were asked for or allowed
    missed_limits: Rate  # rows that measure something: how often it was outside their limits
    seconds_median: float | None
    refusal_seconds_median: float | None
    processor_seconds_mean: float | None


def compute_rate(count: int, of: int) -> Rate:
    """Wilson's interval: unlike the normal one it is right for rates near 0, which is where they should be."""
    if of == 0:
        return Rate(count, 0, None, None, None)
    share, z2 = count / of, _Z95**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = _Z95 * math.sqrt(share * (1 - share) / of + z2 / (4 * of**2)) / (1 + z2 / of)
    low = 0.0 if count == 0 else max(0.0, middle - half)
    return Rate(count, of, share, low, 1.0 if count == of else min(1.0, middle + half))


def summarise(trials: Sequence[Mapping], method: str) -> Summary:
    """Summarises the records of stability.json that are of `method`."""
    mine = [trial for trial in trials if trial["method"] == method]
    confusion = {
        demand.value: {
            found.value: sum(t["demand"] == demand.value and t["outcome"] == found.value for t in mine)
            for found in Outcome
        }
        for demand in Demand
    }
    outcomes = {found: sum(by[found.value] for by in confusion.values()) for found in Outcome}
    asked = confusion[Demand.ACCEPT.value]
    published = outcomes[Outcome.ACCEPTED] + outcomes[Outcome.FALSE_ACCEPT]
    refused = outcomes[Outcome.REFUSED] + outcomes[Outcome.REFUSED_OTHERWISE]
    held = [trial["held"] for trial in mine if trial["held"] is not None]
    return Summary(
        method=method,
        trials=len(mine),
        confusion=confusion,
        false_accept=compute_rate(outcomes[Outcome.FALSE_ACCEPT], len(mine)),
        wrong_of_published=compute_rate(outcomes[Outcome.FALSE_ACCEPT], published),
        false_refuse=compute_rate(asked[Outcome.FALSE_REFUSE.value] + asked[Outcome.FAILED.value], sum(asked.values())),
        other_code=compute_rate(outcomes[Outcome.REFUSED_OTHERWISE], refused),
        missed_limits=compute_rate(held.count(False), len(held)),
        seconds_median=_median([t["seconds"] for t in mine]),
        refusal_seconds_median=_median([t["seconds"] for t in mine if not t["published"]]),
        processor_seconds_mean=_mean([t["processor_seconds"] for t in mine]),
    )


def make_report(trials: Sequence[Mapping]) -> dict[str, Any]:
    """Returns what stability.json holds besides its trials; the top rates are the first method's."""
    methods = list(dict.fromkeys(trial["method"] for trial in trials))
    summaries = [summarise(trials, method) for method in methods]
    first = summaries[0] if summaries else summarise(trials, "")
    return {
        "false_accept_rate": first.false_accept.rate,
        "false_accept_interval": [first.false_accept.low, first.false_accept.high],
        "false_refuse_rate": first.false_refuse.rate,
        "false_refuse_interval": [first.false_refuse.low, first.false_refuse.high],
        "methods": [asdict(summary) for summary in summaries],
    }


def _median(values: Sequence[float | None]) -> float | None:
    known = sorted(value for value in values if value is not None)
    middle = len(known) // 2
    if not known:
        return None
    return known[middle] if len(known) % 2 else 0.5 * (known[middle - 1] + known[middle])


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
