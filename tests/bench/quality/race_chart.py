"""The race as a chart: speed against accuracy, and size, of each method beside ours on the same sets of photographs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import mean, median, variance

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from splatnode.extras.evaluate.charts import INK, choose_style, encode_png, style_axes
from splatnode.extras.evaluate.protocol import Row
from splatnode.extras.evaluate.report import OURS, WHOLE, Measure
from splatnode.recon.config import PRESETS

TICKS = (0.5, 1.0, 2.0, 4.0, 8.0)  # of time, over ours
SMALLEST, LARGEST = 25.0, 330.0  # bubble areas, in points^2


@dataclass(frozen=True)
class Point:
    """A method beside ours, in the mean over the sets that both were scored on."""

    method: str
    sets: int
    time: float | None  # over ours; None: nowhere measured
    size: float  # number of Gaussians, over ours
    lead: float  # of the measure over ours, positive where it is better; means over seeds are compared
    spread: float | None  # standard deviation of `lead` were all sets of one seed; None: no set has several


_Set = tuple[str, int]  # scene, number of photographs


def times(ends: Sequence[Row]) -> dict[str, float]:
    """By method: its time over ours, in the median of the sets where both had a core of one kind alone."""
    timed = [row for row in ends if row.psnr is not None and row.seconds.get("total") is not None]
    ours: dict[tuple[str, int, str | None, int | None], list[float]] = {}
    for row in timed:
        if row.method == OURS:
            ours.setdefault((row.scene, row.views, row.processor, row.cores), []).append(row.seconds["total"] or 0.0)
    ratios: dict[str, list[float]] = {}
    for row in timed:
        if same := ours.get((row.scene, row.views, row.processor, row.cores)):
            ratios.setdefault(row.method, []).append((row.seconds["total"] or 0.0) / mean(same))
    return {method: 1.0 if method == OURS else median(found) for method, found in ratios.items()}


def points(ends: Sequence[Row], views: int, measure: Measure) -> list[Point]:
    """Of the sets of so many photographs, a point a method; none of a method whose time was nowhere measured."""
    found = beside([row for row in ends if row.views == views], measure, times(ends))
    return [point for point in found if point.time is not None]


def beside(ends: Sequence[Row], measure: Measure, took: Mapping[str, float]) -> list[Point]:
    """A point a method that has a set in common with ours; `took` is what `times` gives."""
    by_method: dict[str, dict[_Set, list[Row]]] = {}
    for row in ends:
        if measure.value(row) is not None:
            by_method.setdefault(row.method, {}).setdefault((row.scene, row.views), []).append(row)
    ours = by_method.get(OURS, {})
    sign = 1.0 if measure.higher_is_better else -1.0
    found = []
    for method, theirs in by_method.items():
        common = {each: rows for each, rows in theirs.items() if each in ours}
        if not common:
            continue
        size = mean(_size(rows) / _size(ours[each]) for each, rows in common.items())
        leads = [sign * (_mean(measure, rows) - _mean(measure, ours[each])) for each, rows in common.items()]
        spread = _spread(measure, common.values())
        found.append(Point(method, len(common), took.get(method), size, mean(leads), spread))
    return found


def _size(rows: Sequence[Row]) -> float:
    return mean(row.num_gaussians or 0 for row in rows)


def _mean(measure: Measure, rows: Sequence[Row]) -> float:
    return mean(_value(measure, row) for row in rows)


def _spread(measure: Measure, sets: Collection[Sequence[Row]]) -> float | None:
    """Of a mean over sets; a set of one seed counts as varying like the others in the mean."""
    several = [variance(_value(measure, row) for row in rows) for rows in sets if len(rows) > 1]
    return sqrt(mean(several) / len(sets)) if several else None


def _value(measure: Measure, row: Row) -> float:
    value = measure.value(row)
    assert value is not None  # rows without it were left out
    return value


def draw(ends: Sequence[Row]) -> bytes:
    """A PNG: a row of charts a number of photographs, a column a measure. Some of ours must have been timed."""
    views = [count for count in sorted({row.views for row in ends}) if points(ends, count, WHOLE[0])]
    figure = Figure(figsize=(4.3 * len(WHOLE), 3.2 * len(views) + 1.9), dpi=150, layout="constrained")
    axes = figure.subplots(len(views), len(WHOLE), squeeze=False, sharex=True)
    recipes = list(dict.fromkeys(row.method.partition("+")[0] for row in ends))
    for charts, count in zip(axes, views, strict=True):
        for chart, measure in zip(charts, WHOLE, strict=True):
            found = points(ends, count, measure)
            _chart(chart, found, recipes)
            chart.set_ylabel(f"{measure.name}: how much better than {OURS}", fontsize=8)
        sets = [point.sets for point in points(ends, count, WHOLE[0])]
        title = f"{count} photographs, {min(sets)} to {max(sets)} sets"
        charts[0].set_title(title, loc="left", color=INK, fontsize=10, weight="bold")
    for chart in axes[-1]:
        chart.set_xlabel(f"time over {OURS}'s (log scale)", fontsize=8)
    _legend(figure, recipes)
    figure.suptitle(
        f"The race: every method beside {OURS}, in the mean of the sets that both have; up and left is better\n"
        "Area: number of Gaussians. Bars: standard deviation between seeds of the mean, where a method has several",
        x=0.01,
        ha="left",
        color=INK,
        fontsize=11,
    )
    return encode_png(figure)


def _chart(chart: Axes, found: Sequence[Point], recipes: Sequence[str]) -> None:
    largest = max(point.size for point in found)
    for point in found:
        recipe, _, filled = point.method.partition("+")
        colour, marker = choose_style(recipes.index(recipe))
        if point.spread is not None:
            chart.errorbar(point.time, point.lead, yerr=point.spread, color=colour, linewidth=1.2, capsize=3, zorder=2)
        area = SMALLEST + (LARGEST - SMALLEST) * point.size / largest
        face = colour if filled or recipe in PRESETS else "none"
        chart.scatter(point.time, point.lead, s=area, marker=marker, edgecolors=colour, facecolors=face, zorder=3)
    chart.axhline(0.0, color=INK, linewidth=1.0, zorder=1)
    chart.set_xscale("log")
    chart.set_xticks(TICKS)
    chart.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    chart.xaxis.set_minor_locator(NullLocator())
    chart.xaxis.set_minor_formatter(NullFormatter())
    chart.margins(0.12, 0.15)
    style_axes(chart)


def _legend(figure: Figure, recipes: Sequence[str]) -> None:
    handles = [
        Line2D(
            [], [], color=choose_style(i)[0], marker=choose_style(i)[1], label=recipe, linestyle="none", markersize=7
        )
        for i, recipe in enumerate(recipes)
    ]
    hollow = Line2D([], [], color=INK, marker="o", markerfacecolor="none", linestyle="none", label="as published")
    full = Line2D([], [], color=INK, marker="o", linestyle="none", label="with our background, or ours")
    figure.legend(handles=[*handles, full, hollow], loc="outside lower center", ncols=5, frameon=False, fontsize=9)
