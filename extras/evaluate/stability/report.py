"""The trials counted: how often a wrong scene was published, how often a right one refused."""

from __future__ import annotations

import argparse
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from splatnode.extras.evaluate.dataset import read_json
from splatnode.extras.evaluate.stability.trial import Demand, Outcome
from splatnode.recon.result.export.staged import write_files

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


# Draws stability.json: `python -m splatnode.extras.evaluate.stability.report stability.json --out DIR`.
#
# Needs matplotlib (pip install 'splatnode[bench]').

_INK, _MUTED, _GRID = "#222222", "#6B6B6B", "#E4E4E4"
# Blue is right and vermilion is dangerous, as in the charts of the benchmark: told apart with any colour vision.
_COLOURS = {
    Outcome.ACCEPTED: "#9CC9E8",
    Outcome.REFUSED: "#DCE9F2",
    Outcome.REFUSED_OTHERWISE: "#F2EBC2",
    Outcome.FALSE_REFUSE: "#E69F00",
    Outcome.FALSE_ACCEPT: "#D55E00",
    Outcome.FAILED: "#7F7F7F",
}
_OUTCOME_LABELS = {
    Outcome.ACCEPTED: "published,\nnot wrong",
    Outcome.FALSE_ACCEPT: "published,\nwrong",
    Outcome.REFUSED: "refused,\nfitting code",
    Outcome.REFUSED_OTHERWISE: "refused,\nother code",
    Outcome.FALSE_REFUSE: "refused,\nwas enough",
    Outcome.FAILED: "no\nanswer",
}
_DEMAND_LABELS = {Demand.ACCEPT: "should accept", Demand.REFUSE: "should refuse", Demand.EITHER: "either"}
_CELL, _LINE, _NAMES, _TABLE = 0.86, 0.17, 2.3, 2.1  # inches


def draw(stability_json: Path, out: Path) -> Path:
    """Writes stability.png to `out`. Raises ValueError where there is no trial to draw."""
    content = read_json(stability_json, dict, "the stability.json of a campaign")
    if not content.get("trials"):
        raise ValueError(f"{stability_json} must have a trial to draw, it has none")
    buffer = io.BytesIO()
    make_figure(content).savefig(buffer, format="png", facecolor="white")
    write_files(out, {"stability.png": buffer.getvalue()})
    return out / "stability.png"


def make_figure(content: Mapping) -> Figure:
    """Above, for each method what it did against what was asked, and its rates; below, every trial's verdict."""
    trials, summaries = content["trials"], content["methods"]
    rows = list(dict.fromkeys((trial["row"], trial["name"]) for trial in trials))
    seeds = sorted({trial["seed"] for trial in trials})
    width = _NAMES + len(summaries) * max(_CELL * len(seeds) + 0.2, 4.4)
    height = 1.0 + _TABLE + _LINE * (len(rows) + 2) + 0.7
    figure = Figure(figsize=(width, height), dpi=150)
    share = (width - _NAMES - 0.1) / len(summaries) / width
    for number, summary in enumerate(summaries):
        left = _NAMES / width + number * share
        mine = [trial for trial in trials if trial["method"] == summary["method"]]
        top = 1.0 - (0.75 + _TABLE) / height
        _draw_table(figure.add_axes((left, top, share - 0.1 / width, (_TABLE - 0.65) / height)), summary)
        strip = figure.add_axes((left, 0.65 / height, share - 0.1 / width, _LINE * len(rows) / height))
        _draw_strip(strip, mine, rows, seeds, with_names=number == 0)
    figure.text(
        0.1 / width, 1.0 - 0.28 / height, "How often the answer is wrong: the stability matrix", color=_INK, fontsize=12
    )
    handles = [Patch(color=_COLOURS[found], label=text.replace("\n", " ")) for found, text in _OUTCOME_LABELS.items()]
    figure.legend(handles=handles, loc="lower left", ncols=3 if width < 10 else 6, frameon=False, fontsize=7.5)
    return figure


def _draw_table(axes: Axes, summary: Mapping) -> None:
    """Counts of outcomes by what was asked, and the rates with their 95 % intervals."""
    columns = list(_OUTCOME_LABELS)
    axes.set_xlim(-1.2, len(columns))
    axes.set_ylim(len(_DEMAND_LABELS), -1.0)
    axes.axis("off")
    for x, found in enumerate(columns):
        axes.text(x + 0.5, -0.12, _OUTCOME_LABELS[found], ha="center", va="bottom", fontsize=6.5, color=_MUTED)
    for y, (demand, text) in enumerate(_DEMAND_LABELS.items()):
        axes.text(-0.08, y + 0.5, text, ha="right", va="center", fontsize=7.5, color=_INK)
        for x, found in enumerate(columns):
            count = summary["confusion"][demand.value][found.value]
            colour = _COLOURS[found] if count else "#FAFAFA"
            axes.add_patch(Rectangle((x, y), 1, 1, facecolor=colour, edgecolor="white", linewidth=1.5))
            axes.text(x + 0.5, y + 0.5, str(count) if count else "·", ha="center", va="center", color=_INK, fontsize=9)
    lines = [
        f"{summary['method']}: {summary['trials']} trials",
        f"false accepts {_format_rate(summary['false_accept'])}",
        f"false refusals {_format_rate(summary['false_refuse'])}",
    ]
    axes.set_title("\n".join(lines), loc="left", fontsize=9, color=_INK, pad=14)


def _draw_strip(
    axes: Axes, trials: Sequence[Mapping], rows: Sequence[tuple[int, str]], seeds: Sequence[int], *, with_names: bool
) -> None:
    """A line a row, a cell a seed: the colour tells the outcome, the text the verdict."""
    axes.set_xlim(0, len(seeds))
    axes.set_ylim(len(rows), 0)
    for trial in trials:
        x, y = seeds.index(trial["seed"]), rows.index((trial["row"], trial["name"]))
        colour = _COLOURS[Outcome(trial["outcome"])]
        axes.add_patch(Rectangle((x, y), 1, 1, facecolor=colour, edgecolor="white", linewidth=1.0))
        mark = " *" if trial["held"] is False else ""
        axes.text(x + 0.5, y + 0.53, trial["verdict"] + mark, ha="center", va="center", fontsize=5.6, color=_INK)
    axes.set_xticks([i + 0.5 for i in range(len(seeds))], [f"seed {seed}" for seed in seeds])
    axes.xaxis.tick_top()
    names = [f"{name}  {number:>2}" for number, name in rows] if with_names else [""] * len(rows)
    axes.set_yticks([i + 0.5 for i in range(len(rows))], names)
    axes.tick_params(length=0, labelsize=6.5, colors=_INK)
    axes.spines[:].set_visible(False)
    for y in range(1, len(rows)):
        if rows[y][0] != rows[y - 1][0]:
            axes.axhline(y, color=_GRID, linewidth=0.8, zorder=0)
    if any(trial["held"] is False for trial in trials):
        axes.set_xlabel("*: what the row measures besides is outside its limits", fontsize=6.5, color=_MUTED)


def _format_rate(rate: Mapping) -> str:
    if rate["rate"] is None:
        return "not tried"
    return f"{rate['count']}/{rate['of']} = {rate['rate']:.1%} (95 %: {rate['low']:.1%} to {rate['high']:.1%})"


def main() -> None:
    parser = argparse.ArgumentParser(description="Draws the chart of a stability campaign from its stability.json.")
    parser.add_argument("stability_json", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    arguments = parser.parse_args()
    draw(arguments.stability_json, arguments.out)


if __name__ == "__main__":
    main()
