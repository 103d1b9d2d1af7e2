"""The chart of the cases: how far ours is ahead of, or behind, the best other method on each set of photographs."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from splatnode.recon.evaluate.charts import AHEAD, BEHIND, INK, encode_png, style_axes
from splatnode.recon.evaluate.contest import OURS, SHOWN, WHOLE, Margin, compute_margins
from splatnode.recon.evaluate.protocol import Row


def draw(rows: Sequence[Row]) -> dict[str, bytes]:
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
