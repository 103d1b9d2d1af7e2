"""Draws windows.json: `python -m splatnode.recon.evaluate.stability.windows.charts windows.json --out DIR`.

Needs matplotlib (pip install 'splatnode[bench]').
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator, PercentFormatter

from splatnode.recon.evaluate.stability.windows.campaign import read_rows
from splatnode.recon.evaluate.stability.windows.row import WindowOutcome, WindowRow
from splatnode.recon.evaluate.stability.windows.summary import (
    compute_share_within,
    group_by_angle,
    group_by_count,
    group_by_method,
)
from splatnode.recon.result.export.staged import write_files

_INK, _MUTED, _GRID = "#222222", "#6B6B6B", "#E4E4E4"
# Blue is right and vermilion is dangerous, as in the other charts: told apart with any colour vision.
_FOUND = {  # from the bottom of a bar to its top
    WindowOutcome.RIGHT: ("#2F7FB5", "published: right, all photographs placed"),
    WindowOutcome.RIGHT_PART: ("#9CC9E8", "published: right, some photographs left out"),
    WindowOutcome.BETWEEN: ("#F2D98B", "published: less exact, not wrong"),
    WindowOutcome.WRONG: ("#D55E00", "published: wrong"),
    WindowOutcome.REFUSED: ("#ECECEC", "no cameras published"),
    WindowOutcome.FAILED: ("#7F7F7F", "no answer"),
}
_COUNT_COLOURS = ("#CC79A7", "#0072B2", "#009E73", "#E69F00")
_NAMES = {"colmap": "COLMAP", "glomap": "GLOMAP"}
_CLAIMS = {"rotation": "rotation, degrees", "centre": "centre, % of the distance to the scene"}
_LEAST = 1e-3  # degrees or percent: what is smaller is drawn here
_WRONG_BELOW = (
    "Right: every camera within 2° and 5 % of the cameras' spread. Wrong: a camera beyond 2.5 times its 95 % bound, "
    "or, unless the\nverdict says rough, beyond 5° or 10 % of the distance to the scene; COLMAP and GLOMAP, which "
    "claim nothing: beyond 5° or 10 % of the spread."
)


def draw(rows: Sequence[WindowRow], out: Path) -> list[str]:
    """Writes the charts to `out` and returns their names; those that there is nothing to draw for are left out."""
    figures = {}
    if rows:
        figures["windows.png"] = make_shares_figure(rows)
    if any(camera.pair_with_bounds() for row in rows if row.published for camera in row.cameras):
        figures["calibration.png"] = make_bounds_figure(rows)
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", facecolor="white")
        write_files(out, {name: buffer.getvalue()})
    return list(figures)


def make_shares_figure(rows: Sequence[WindowRow]) -> Figure:
    """A panel a method: shares of what was published, by the angle between neighbouring views."""
    methods = group_by_method(rows)
    width, height = 1.0 + 3.6 * max(len(methods), 2), 4.6
    figure = Figure(figsize=(width, height), dpi=150)
    for number, (method, mine) in enumerate(methods.items()):
        share = (width - 1.0) / len(methods) / width
        axes = figure.add_axes((0.7 / width + number * share, 1.3 / height, share - 0.15 / width, 2.6 / height))
        _draw_shares(axes, method, mine, labelled=number == 0)
    title = "Windows of 3, 6 and 12 consecutive photographs, by the angle between neighbouring views"
    figure.text(0.1 / width, 1.0 - 0.3 / height, title, color=_INK, fontsize=11 if len(methods) > 2 else 8.5)
    there = {row.outcome for row in rows}
    handles = [Patch(color=colour, label=text) for found, (colour, text) in _FOUND.items() if found in there]
    figure.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.0, 0.42 / height), ncols=3, frameon=False, fontsize=7.5
    )
    figure.text(0.1 / width, 0.12 / height, _WRONG_BELOW, color=_MUTED, fontsize=6.8 if len(methods) > 2 else 4.8)
    return figure


def _draw_shares(axes: Axes, method: str, rows: Sequence[WindowRow], *, labelled: bool) -> None:
    bins = {name: some for name, some in group_by_angle(rows).items() if some}
    for x, some in enumerate(bins.values()):
        bottom = 0.0
        for found, (colour, _) in _FOUND.items():
            count = sum(row.outcome is found for row in some)
            share = count / len(some)
            axes.bar(x, share, 0.82, bottom=bottom, color=colour, edgecolor="white", linewidth=0.8)
            if count:
                ink = "white" if found in (WindowOutcome.RIGHT, WindowOutcome.WRONG, WindowOutcome.FAILED) else _INK
                axes.text(x, bottom + share / 2, str(count), ha="center", va="center", fontsize=6.5, color=ink)
            bottom += share
    axes.set_xticks(range(len(bins)), [f"{name}°\n{len(some)} sets" for name, some in bins.items()])
    axes.set_xlim(-0.55, len(bins) - 0.45)
    axes.set_ylim(0, 1)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.tick_params(length=0, labelsize=6.5, colors=_INK, labelleft=labelled)
    axes.spines[:].set_visible(False)
    right = sum(row.outcome in (WindowOutcome.RIGHT, WindowOutcome.RIGHT_PART) for row in rows)
    wrong = sum(row.outcome is WindowOutcome.WRONG for row in rows)
    name = _NAMES.get(method, method)
    axes.set_title(f"{name}: {right} of {len(rows)} right, {wrong} wrong", loc="left", fontsize=9, color=_INK)
    if labelled:
        axes.set_ylabel("share of the sets", fontsize=7.5, color=_MUTED)


def make_bounds_figure(rows: Sequence[WindowRow]) -> Figure:
    """A panel a kind of error: what was found against what was claimed, a dot a published camera."""
    width, height = 9.6, 5.0
    figure = Figure(figsize=(width, height), dpi=150)
    for number, (kind, text) in enumerate(_CLAIMS.items()):
        axes = figure.add_axes(((0.75 + 4.75 * number) / width, 0.55 / height, 3.95 / width, 3.85 / height))
        _draw_bounds(axes, kind, text, group_by_count([row for row in rows if row.published]))
    title = "What the 95 % bounds are worth: the error of each published camera against its bound"
    figure.text(0.1 / width, 1.0 - 0.3 / height, title, color=_INK, fontsize=11)
    return figure


def _draw_bounds(axes: Axes, kind: str, text: str, rows: dict[int, list[WindowRow]]) -> None:
    everything: list[tuple[float, float]] = []
    for (count, some), colour in zip(rows.items(), _COUNT_COLOURS * len(rows), strict=False):
        pairs = [
            camera.pair_with_bounds()[kind]
            for row in some
            for camera in row.cameras
            if kind in camera.pair_with_bounds()
        ]
        share = compute_share_within(pairs)
        if share is None:
            continue
        error, bound = np.maximum(np.array(pairs).T, _LEAST)
        label = f"{count} views: {share:.0%} of {len(pairs)} cameras within"
        axes.scatter(bound, error, 9, color=colour, alpha=0.55, linewidths=0, label=label, zorder=2)
        everything += pairs
    values = np.maximum(np.array(everything).ravel(), _LEAST) if everything else np.array([_LEAST, 1.0])
    low, high = 10.0 ** np.floor(np.log10(values.min())), 10.0 ** np.ceil(np.log10(values.max() * 1.01))
    line = np.array([low, high])
    axes.fill_between(line, line, high, color="#FBEDE4", zorder=0)
    axes.plot(line, line, color=_INK, linewidth=1.0, zorder=1)
    axes.plot(line, 2.5 * line, color="#D55E00", linewidth=1.0, linestyle="--", zorder=1)
    axes.text(
        low * 1.3, high / 1.3, "beyond the bound;\nabove the dashed line: wrong", va="top", fontsize=7, color=_MUTED
    )
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    axes.set_xlabel(f"95 % bound: {text}", fontsize=7.5, color=_INK)
    axes.set_ylabel(f"error: {text}", fontsize=7.5, color=_INK)
    axes.tick_params(labelsize=7, colors=_INK)
    axes.grid(color=_GRID, linewidth=0.6, zorder=0)
    axes.spines[:].set_visible(False)
    axes.legend(loc="lower right", fontsize=7, frameon=True, framealpha=0.9, edgecolor="none", markerscale=1.6)


def main() -> None:
    parser = argparse.ArgumentParser(description="Draws the charts of the windows from their windows.json.")
    parser.add_argument("windows_json", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    arguments = parser.parse_args()
    draw(read_rows(arguments.windows_json), arguments.out)


if __name__ == "__main__":
    main()
