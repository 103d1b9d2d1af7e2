"""Charts of a benchmark and of a stability campaign, drawn from their numbers alone: never an image of a scene.

Needs matplotlib (pip install 'splatnode[bench]').
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from splatnode.extras.evaluate.dataset import read_json
from splatnode.extras.evaluate.methods import is_variant, list_variants
from splatnode.extras.evaluate.protocol import Row, compute_mean
from splatnode.extras.evaluate.report import (
    OURS,
    PSNR,
    SHOWN,
    SSIM,
    WHOLE,
    Margin,
    Measure,
    MethodMean,
    compute_margins,
    compute_method_means,
    compute_paired_changes,
    select_lpips,
    select_shared_runs,
)
from splatnode.extras.evaluate.stability.trial import Demand, Outcome
from splatnode.recon.result.export.staged import write_files

# A benchmark, from its rows: `splatnode bench --redraw bench.json --out DIR`.

# Okabe and Ito's colours, which people with any colour vision tell apart, and a marker each for print without colour.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#7F7F7F")
AHEAD, BEHIND = _COLOURS[0], _COLOURS[1]  # of what is better, and worse, than what it is compared with
_MARKERS = "osD^vP*X"
INK, _MUTED, _GRID = "#222222", "#6B6B6B", "#E4E4E4"
_SMALLEST, _LARGEST = 20.0, 320.0  # bubble areas, in points^2


@dataclass(frozen=True)
class Quality:
    """A measure of held-out views. Axes are turned so that better is up."""

    label: str
    value: Callable[[MethodMean], float | None]
    higher_is_better: bool


_PSNR = Quality("PSNR (dB)", lambda point: point.psnr, True)
_SSIM = Quality("SSIM", lambda point: point.ssim, True)
_LPIPS_VGG = Quality("LPIPS VGG", lambda point: point.lpips_vgg, False)
_LPIPS_ALEX = Quality("LPIPS Alex", lambda point: point.lpips_alex, False)


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
    """speed_accuracy.png and parsimony.png, and ablation.png where parts were measured; none where nothing was scored.

    What has no seconds is left out of the first, fields, which have no Gaussians, of the second. Methods that were made
    for the ablation are drawn there alone.
    """
    files = {}
    measured = [
        p
        for p in compute_method_means(select_shared_runs([row for row in rows if not is_variant(row.method)]))
        if p.psnr is not None
    ]
    if timed := [p for p in measured if p.seconds]:
        files["speed_accuracy.png"] = encode_png(draw_speed_accuracy(timed))
    if sized := [p for p in measured if p.num_gaussians]:
        files["parsimony.png"] = encode_png(draw_parsimony(sized))
    scored = [row for row in rows if row.final and row.psnr is not None]
    if any(is_variant(row.method) for row in scored):
        files["ablation.png"] = encode_png(draw_ablation(scored))
    return files


def draw_speed_accuracy(measured: Sequence[MethodMean]) -> Figure:
    """Seconds against quality: a curve a method through its checkpoints, a bubble's area is the number of Gaussians."""
    largest = max((p.num_gaussians or 0.0 for p in measured), default=0.0)

    def area(point: MethodMean) -> float:
        share = (point.num_gaussians or 0.0) / largest if largest else 0.0
        return _SMALLEST + (_LARGEST - _SMALLEST) * share

    figure = _draw_grid(measured, "seconds (log scale)", lambda p: p.seconds, area)
    _set_title(figure, "Quality of held-out views against time", f"Area: number of Gaussians, at most {largest:,.0f}. ")
    return figure


def draw_parsimony(measured: Sequence[MethodMean]) -> Figure:
    """Number of Gaussians against quality: what a method buys with its scene's size."""
    figure = _draw_grid(measured, "Gaussians (log scale)", lambda p: p.num_gaussians, lambda p: 45.0)
    _set_title(figure, "Quality of held-out views against the number of Gaussians")
    return figure


def draw_ablation(scored: Sequence[Row]) -> Figure:
    """Draws what each variant changes against its reference: bars are means, dots the common runs."""
    shown = [v for v in list_variants({row.method for row in scored}) if v.method != v.against]
    measures = [measure for measure in (PSNR, SSIM, select_lpips(scored)) if measure is not None]
    figure = Figure(figsize=(4.6 * len(measures), 0.36 * len(shown) + 1.9), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(measures), squeeze=False, sharey=True)[0]
    for chart, measure in zip(axes, measures, strict=True):
        for place, variant in enumerate(shown):
            changes = compute_paired_changes(scored, variant.method, variant.against, measure)
            chart.barh(
                place,
                compute_mean(changes) or 0.0,
                height=0.6,
                color=_COLOURS[_choose_bar_colour(changes, measure)],
                alpha=0.8,
            )
            chart.scatter(changes, [place] * len(changes), s=14, c=INK, zorder=3)
        chart.axvline(0.0, color=INK, linewidth=1.0)
        chart.set_title(f"{measure.name} ({'more' if measure.higher_is_better else 'less'} is better)", fontsize=10)
        style_axes(chart)
    axes[0].set_yticks(range(len(shown)), [f"{v.method}  vs. {v.against}" for v in shown])
    axes[0].invert_yaxis()
    figure.suptitle(
        "What each part changes on held-out views (blue: for the better; dots: runs)", fontsize=11, color=INK
    )
    return figure


def _choose_bar_colour(changes: Sequence[float], measure: Measure) -> int:
    """Returns the colour of a bar: 0 where the change is for the better, else 1."""
    return int(((compute_mean(changes) or 0.0) > 0) != measure.higher_is_better)


def find_pareto_front(pairs: Sequence[tuple[float, float]], higher_is_better: bool) -> list[tuple[float, float]]:
    """The (cost, quality) pairs that no other beats in both, by rising cost."""
    front: list[tuple[float, float]] = []
    sign = 1.0 if higher_is_better else -1.0
    for cost, quality in sorted(pairs, key=lambda pair: (pair[0], -sign * pair[1])):
        if not front or sign * quality > sign * front[-1][1]:
            front.append((cost, quality))
    return front


def _draw_grid(
    measured: Sequence[MethodMean],
    x_label: str,
    x: Callable[[MethodMean], float | None],
    area: Callable[[MethodMean], float],
) -> Figure:
    """A row of charts a number of views, a column a measure."""
    views = sorted({p.views for p in measured})
    qualities = _select_qualities(measured)
    methods = list(dict.fromkeys(p.method for p in measured))
    figure = Figure(figsize=(4.3 * len(qualities), 3.3 * len(views) + 1.5), dpi=150, layout="constrained")
    axes = figure.subplots(len(views), len(qualities), squeeze=False, sharex=True)
    for row, count in enumerate(views):
        here = [p for p in measured if p.views == count]
        for column, quality in enumerate(qualities):
            chart = axes[row][column]
            _draw_chart(chart, here, methods, quality, x, area)
            chart.set_title(f"{count} views" if column == 0 else "", loc="left", color=INK, fontsize=11, weight="bold")
            if row == len(views) - 1:
                chart.set_xlabel(x_label, color=_MUTED)
    handles = [
        Line2D([], [], color=choose_style(i)[0], marker=choose_style(i)[1], label=method, linewidth=1.8)
        for i, method in enumerate(methods)
    ]
    handles.append(Line2D([], [], color=_MUTED, linestyle=(0, (4, 3)), linewidth=1.2, label="Pareto front"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(6, len(handles)), frameon=False, fontsize=9)
    return figure


def _draw_chart(
    chart: Axes,
    here: Sequence[MethodMean],
    methods: Sequence[str],
    quality: Quality,
    x: Callable[[MethodMean], float | None],
    area: Callable[[MethodMean], float],
) -> None:
    drawn = [(p, cost, value) for p in here if (cost := x(p)) and (value := quality.value(p)) is not None]
    front = find_pareto_front([(cost, value) for _, cost, value in drawn], quality.higher_is_better)
    if front:
        chart.step(
            *zip(*front, strict=True), where="post", color=_MUTED, linestyle=(0, (4, 3)), linewidth=1.2, zorder=1
        )
    for i, method in enumerate(methods):
        curve = [entry for entry in drawn if entry[0].method == method]
        colour, marker = choose_style(i)
        costs, values = [cost for _, cost, _ in curve], [value for _, _, value in curve]
        chart.plot(costs, values, color=colour, linewidth=1.8, zorder=2)
        chart.scatter(
            costs,
            values,
            s=[area(p) for p, _, _ in curve],
            c=colour,
            marker=marker,
            alpha=0.8,
            edgecolors="white",
            zorder=3,
        )
    chart.set_xscale("log")
    chart.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    chart.xaxis.set_major_formatter(FuncFormatter(_format_tick))
    chart.xaxis.set_minor_formatter(NullFormatter())
    chart.tick_params(labelbottom=True)
    chart.margins(0.12, 0.15)
    if not quality.higher_is_better:
        chart.invert_yaxis()
    chart.set_ylabel(quality.label if quality.higher_is_better else f"{quality.label} (axis turned)", color=_MUTED)
    style_axes(chart)


def style_axes(chart: Axes) -> None:
    """A chart with a light grid and no frame."""
    chart.grid(color=_GRID, linewidth=0.7)
    chart.set_axisbelow(True)
    chart.spines[["top", "right"]].set_visible(False)
    chart.spines[["left", "bottom"]].set_color(_MUTED)
    chart.tick_params(colors=_MUTED, labelsize=8)


def _select_qualities(measured: Sequence[MethodMean]) -> list[Quality]:
    """PSNR, SSIM and the LPIPS that was measured more often, VGG's rather than AlexNet's: checkpoints lack it."""
    counts = {quality: sum(quality.value(p) is not None for p in measured) for quality in (_LPIPS_VGG, _LPIPS_ALEX)}
    most = max(counts, key=lambda quality: counts[quality])
    return [_PSNR, _SSIM, *([most] if counts[most] else [])]


def choose_style(index: int) -> tuple[str, str]:
    """The colour and the marker of the method in this place."""
    return _COLOURS[index % len(_COLOURS)], _MARKERS[index % len(_MARKERS)]


def _format_tick(value: float, _position: int) -> str:
    """1500 as 1.5k: ticks must fit beside each other."""
    if value >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if value >= 1e3 else f"{value:g}"


def _set_title(figure: Figure, title: str, remark: str = "") -> None:
    remark += "Means over the runs that published a scene; up and left is better."
    figure.suptitle(f"{title}\n{remark}", x=0.01, ha="left", color=INK, fontsize=11)


def encode_png(figure: Figure) -> bytes:
    """The figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor="white")
    return buffer.getvalue()


# The chart of the cases: how far ours is ahead of, or behind, the best other method on each set of photographs.


def draw_case_charts(rows: Sequence[Row]) -> dict[str, bytes]:
    """cases.png; nothing where ours and another method have no case in common."""
    ends = [row for row in rows if row.final]
    figure = draw_cases(ends) if compute_margins(ends, WHOLE[0]) else None
    return {} if figure is None else {"cases.png": encode_png(figure)}


def draw_cases(ends: Sequence[Row]) -> Figure:
    """A chart a measure, a line a case: filled for whole photographs, hollow for what training photographs show."""
    pairs = [
        (compute_margins(ends, whole), compute_margins(ends, shown)) for whole, shown in zip(WHOLE, SHOWN, strict=True)
    ]
    pairs = [pair for pair in pairs if pair[0]]
    names = [_format_name(each) for each in pairs[0][0]]
    figure = Figure(figsize=(3.6 * len(pairs) + 1.6, 0.32 * len(names) + 2.2), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(pairs), squeeze=False, sharey=True)[0]
    for chart, (whole, shown) in zip(axes, pairs, strict=True):
        for found, hollow in ((whole, False), (shown, True)):
            for each in (each for each in found if _format_name(each) in names):
                colour = AHEAD if each.lead >= 0 else BEHIND
                face = "none" if hollow else colour
                at = names.index(_format_name(each))
                chart.scatter(each.lead, at, s=34, edgecolors=colour, facecolors=face, zorder=3)
                if each.error is not None and not hollow:
                    chart.errorbar(each.lead, at, xerr=each.error, color=colour, linewidth=1.2, capsize=3, zorder=2)
        chart.axvline(0.0, color=INK, linewidth=1.0)
        chart.set_title(f"{whole[0].measure.name}: lead over the best other", fontsize=10)
        style_axes(chart)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    figure.suptitle(
        f"{OURS} against the best other method, case by case (right of the line: ours is better; filled: whole held-out"
        " photographs, hollow: what training photographs show of them; bars: standard error of both's seeds)",
        x=0.01,
        ha="left",
        color=INK,
        fontsize=10,
        wrap=True,
    )
    return figure


def _format_name(margin: Margin) -> str:
    return f"{margin.scene}, {margin.views} views"


# Draws stability.json: `python -m splatnode.extras.evaluate.stability.campaign stability.json --out DIR`.
#
# Needs matplotlib (pip install 'splatnode[bench]').

# Blue is right and vermilion is dangerous, as in the charts of the benchmark: told apart with any colour vision.
_OUTCOME_COLOURS = {
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


def draw_stability(stability_json: Path, out: Path) -> Path:
    """Writes stability.png to `out`. Raises ValueError where there is no trial to draw."""
    content = read_json(stability_json, dict, "the stability.json of a campaign")
    if not content.get("trials"):
        raise ValueError(f"{stability_json} must have a trial to draw, it has none")
    buffer = io.BytesIO()
    make_stability_figure(content).savefig(buffer, format="png", facecolor="white")
    write_files(out, {"stability.png": buffer.getvalue()})
    return out / "stability.png"


def make_stability_figure(content: Mapping) -> Figure:
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
        0.1 / width, 1.0 - 0.28 / height, "How often the answer is wrong: the stability matrix", color=INK, fontsize=12
    )
    handles = [
        Patch(color=_OUTCOME_COLOURS[found], label=text.replace("\n", " ")) for found, text in _OUTCOME_LABELS.items()
    ]
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
        axes.text(-0.08, y + 0.5, text, ha="right", va="center", fontsize=7.5, color=INK)
        for x, found in enumerate(columns):
            count = summary["confusion"][demand.value][found.value]
            colour = _OUTCOME_COLOURS[found] if count else "#FAFAFA"
            axes.add_patch(Rectangle((x, y), 1, 1, facecolor=colour, edgecolor="white", linewidth=1.5))
            axes.text(x + 0.5, y + 0.5, str(count) if count else "·", ha="center", va="center", color=INK, fontsize=9)
    lines = [
        f"{summary['method']}: {summary['trials']} trials",
        f"false accepts {_format_rate(summary['false_accept'])}",
        f"false refusals {_format_rate(summary['false_refuse'])}",
    ]
    axes.set_title("\n".join(lines), loc="left", fontsize=9, color=INK, pad=14)


def _draw_strip(
    axes: Axes, trials: Sequence[Mapping], rows: Sequence[tuple[int, str]], seeds: Sequence[int], *, with_names: bool
) -> None:
    """A line a row, a cell a seed: the colour tells the outcome, the text the verdict."""
    axes.set_xlim(0, len(seeds))
    axes.set_ylim(len(rows), 0)
    for trial in trials:
        x, y = seeds.index(trial["seed"]), rows.index((trial["row"], trial["name"]))
        colour = _OUTCOME_COLOURS[Outcome(trial["outcome"])]
        axes.add_patch(Rectangle((x, y), 1, 1, facecolor=colour, edgecolor="white", linewidth=1.0))
        mark = " *" if trial["held"] is False else ""
        axes.text(x + 0.5, y + 0.53, trial["verdict"] + mark, ha="center", va="center", fontsize=5.6, color=INK)
    axes.set_xticks([i + 0.5 for i in range(len(seeds))], [f"seed {seed}" for seed in seeds])
    axes.xaxis.tick_top()
    names = [f"{name}  {number:>2}" for number, name in rows] if with_names else [""] * len(rows)
    axes.set_yticks([i + 0.5 for i in range(len(rows))], names)
    axes.tick_params(length=0, labelsize=6.5, colors=INK)
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
    draw_stability(arguments.stability_json, arguments.out)


if __name__ == "__main__":
    main()
