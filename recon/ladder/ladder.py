"""The ladder before the no: what costs more is tried before photographs are refused for want of matches.

The first estimate is the first rung. While it lacks cameras for some keyframes, and the seconds last, further rungs
find more to estimate from, and cameras are estimated again. An answer is never made worse: the better one is kept.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from splatnode.recon.config import Config
from splatnode.recon.estimation import Estimate, estimate_cameras
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.ladder import learned, tilts
from splatnode.recon.ladder.better import better
from splatnode.recon.ladder.others import without_the_doubtful
from splatnode.recon.ladder.rung import Means, Rung
from splatnode.recon.result.verdict import Code

log = logging.getLogger(__name__)

RUNGS = (learned.RUNG, tilts.RUNG)  # what wins most for its seconds comes first
LACKING_MATCHES = (Code.NO_OVERLAP, Code.SPLIT, Code.OK_PARTIAL, Code.AMBIGUOUS)
# Of the others, what more cameras may mend, where some keyframes have none: few leave much open.
UNCERTAIN = (Code.OK_ROUGH, Code.TOO_ROUGH, Code.FOCAL_SUSPECT, Code.PLANAR_ONLY, Code.BASELINE_TOO_SMALL)


def climbed(
    estimate: Estimate,
    rejected: Sequence[Rejected],
    config: Config,
    pause: Callable[[], None] = lambda: None,
    rungs: Sequence[Rung] = RUNGS,
    until: float = math.inf,
) -> Estimate:
    """The best of `estimate` and what the `rungs` lead to; a refusal then says what was tried.

    With `config.quick` it is `estimate`. `config.ladder.seconds` bounds the work that is added: they are looked at
    between pairs and before each rung, as is `until`, a time of `time.monotonic()`. A pair and an estimate that have
    begun are finished. Where that does not help, photographs in doubt are left out. `pause` may raise.
    """
    if config.quick:
        return estimate
    if _lacks_matches(estimate):
        estimate = _with_more(estimate, rejected, config, pause, rungs, until)
    return estimate if time.monotonic() >= until else without_the_doubtful(estimate, rejected, config, pause)


def _with_more(
    estimate: Estimate,
    rejected: Sequence[Rejected],
    config: Config,
    pause: Callable[[], None],
    rungs: Sequence[Rung],
    until: float,
) -> Estimate:
    means, until = Means(estimate.graph, config), min(until, time.monotonic() + config.ladder.seconds)
    tried: list[str] = []
    not_tried: list[str] = []
    for rung in rungs:
        doubtful = doubtful_keyframes(estimate)
        if not doubtful or time.monotonic() >= until:
            break
        obstacle = rung.obstacle()
        if obstacle:
            not_tried.append(f"{rung.name} ({obstacle})")
            continue
        began, before = time.monotonic(), means
        means = _last(rung.climb(before, doubtful), before, until, pause)
        if means is before:
            continue
        other = estimate_cameras(means.graph, rejected, means.config, pause)
        estimate = better(estimate, other)
        gained = "more photographs found their place" if estimate is other else "nothing gained"
        log.info("looked for more matches: %s: %s in %.1f s", rung.name, gained, time.monotonic() - began)
        tried.append(rung.name)
    return _telling(estimate, {"Also tried": tried, "Not tried": not_tried})


def _lacks_matches(estimate: Estimate) -> bool:
    code = estimate.verdict.code
    return code in LACKING_MATCHES or (code in UNCERTAIN and bool(without_cameras(estimate)))


def _last(climb: Iterator[Means], means: Means, until: float, pause: Callable[[], None]) -> Means:
    """The means after the last piece of work that ends before `until`, a time of `time.monotonic()`, or just after."""
    for further in climb:
        means = further
        pause()
        if time.monotonic() >= until:
            break
    return means


def doubtful_keyframes(estimate: Estimate) -> frozenset[str]:
    """The names of those without a camera, and of those that the verdict is about; none where all are published."""
    without = without_cameras(estimate)
    return without if estimate.verdict.publishable else without.union(estimate.verdict.frames)


def without_cameras(estimate: Estimate) -> frozenset[str]:
    """The names of the keyframes that have no camera."""
    return frozenset(estimate.graph.names) - estimate.registered


def _telling(estimate: Estimate, rungs: Mapping[str, Sequence[str]]) -> Estimate:
    """With the names of the rungs in the verdict's message, unless that has nothing left to explain."""
    if not doubtful_keyframes(estimate):
        return estimate
    sentences = [f"{what}: {', '.join(names)}." for what, names in rungs.items() if names]
    message = " ".join([estimate.verdict.message, *sentences])
    return replace(estimate, verdict=replace(estimate.verdict, message=message)) if sentences else estimate
