"""What the benchmark of parsimony measured, told and drawn:
`python -m tests.bench.quality.parsimony_chart JSON PNG`."""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from splatnode.extras.evaluate.charts import find_pareto_front

SELF, PIXEL, RIVAL = "chosen", "pixel", "mcmc"
MEASURES = {"psnr": 1, "ssim": 1, "lpips": -1}  # and whether more is better
LOSS = {"psnr": 0.1, "ssim": 0.005}  # that a small scene may have beside a Gaussian a pixel; of LPIPS:
LPIPS_LOSS = 0.02  # relative
GAIN = {
    "psnr": 0.1,
    "ssim": 0.003,
}  # of twice the size, from which on the chosen one is too small; of LPIPS: LPIPS_LOSS
HALF, TWICE = "x0.5", "x2"

Record = Mapping[str, Any]


def by_case(rows: Sequence[Record]) -> dict[str, dict[str, Record]]:
    """Scored rows by method, by scene and number of views."""
    cases: dict[str, dict[str, Record]] = {}
    for row in rows:
        if row["psnr"] is not None:
            cases.setdefault(f"{row['scene']} {row['views']}", {})[row["method"]] = row
    return {case: methods for case, methods in cases.items() if SELF in methods}


def on_front(methods: Mapping[str, Record], cost: str = "num_gaussians") -> dict[str, bool]:
    """Whether no other scene that costs no more is better than the chosen one: by measure, and in all of them at once.

    "together" says that none is at least as good in every measure.
    """
    chosen = methods[SELF]
    cheaper = [row for name, row in methods.items() if name != SELF and row[cost] <= chosen[cost]]
    alone = {key: all(sign * row[key] <= sign * chosen[key] for row in cheaper) for key, sign in MEASURES.items()}
    beaten = any(all(sign * row[key] >= sign * chosen[key] for key, sign in MEASURES.items()) for row in cheaper)
    return {**alone, "together": not beaten}


def no_worse_than_pixels(methods: Mapping[str, Record]) -> dict[str, bool]:
    """By measure, whether the chosen scene loses no more than is allowed to a Gaussian a pixel."""
    chosen, pixel = methods[SELF], methods[PIXEL]
    return {
        **{key: chosen[key] >= pixel[key] - loss for key, loss in LOSS.items()},
        "lpips": chosen["lpips"] <= (1 + LPIPS_LOSS) * pixel["lpips"],
    }


def half_is_worse(methods: Mapping[str, Record]) -> bool:
    """Whether half the chosen size is worse in at least two of the three measures."""
    chosen, half = methods[SELF], methods[HALF]
    return sum(sign * half[key] < sign * chosen[key] for key, sign in MEASURES.items()) >= 2


def twice_is_better(methods: Mapping[str, Record]) -> dict[str, bool]:
    """By measure, whether twice the chosen size is better by more than is worth it."""
    chosen, twice = methods[SELF], methods[TWICE]
    return {
        **{key: twice[key] > chosen[key] + gain for key, gain in GAIN.items()},
        "lpips": twice["lpips"] < (1 - LPIPS_LOSS) * chosen["lpips"],
    }


def summary(rows: Sequence[Record]) -> dict[str, Any]:
    """What the issue asks for, of the cases that have what it takes."""
    cases = by_case(rows)
    fronts = {case: on_front(methods) for case, methods in cases.items() if len(methods) > 1}
    against = {case: methods for case, methods in cases.items() if PIXEL in methods}
    sized = [methods for methods in cases.values() if HALF in methods and TWICE in methods]
    six = [methods[SELF] for methods in cases.values() if methods[SELF]["views"] == 6]
    return {
        "cases": len(cases),
        "on_front": {key: sum(front[key] for front in fronts.values()) for key in (*MEASURES, "together")},
        "share_of_pixels": _mean(m[SELF]["num_gaussians"] / m[PIXEL]["num_gaussians"] for m in against.values()),
        "no_worse_than_pixels": {
            key: sum(no_worse_than_pixels(methods)[key] for methods in against.values()) for key in MEASURES
        },
        "mean_change_from_pixels": {
            key: _mean(methods[SELF][key] - methods[PIXEL][key] for methods in against.values()) for key in MEASURES
        },
        "compared_with_pixels": len(against),
        "sized": len(sized),
        "half_is_worse": sum(map(half_is_worse, sized)),
        "twice_is_better": {key: sum(twice_is_better(methods)[key] for methods in sized) for key in MEASURES},
        "spz_mb_6_views": _mean(row["spz_bytes"] / 1e6 for row in six),
        "peak_rss_mb_6_views": max((row["peak_rss_mb"] or 0.0 for row in six), default=None),
        "chosen": {case: methods[SELF]["num_gaussians"] for case, methods in cases.items()},
    }


def _mean(values: Any) -> float | None:
    listed = list(values)
    return mean(listed) if listed else None


def draw(rows: Sequence[Record]) -> bytes:
    """A PNG: a row a case; held-out PSNR, SSIM and LPIPS against Gaussians, and PSNR against bytes of .spz."""
    cases = by_case(rows)
    panels = [(key, "num_gaussians", "Gaussians") for key in MEASURES] + [("psnr", "spz_bytes", "bytes of .spz")]
    figure = Figure(figsize=(3.6 * len(panels), 2.4 * len(cases) + 0.9), dpi=110, layout="constrained")
    axes = figure.subplots(len(cases), len(panels), squeeze=False)
    for line, (case, methods) in zip(axes, cases.items(), strict=True):
        for chart, (key, cost, label) in zip(line, panels, strict=True):
            _chart(chart, methods, key, cost)
            chart.set_title(f"{case} views: {key.upper()}", fontsize=9, loc="left")
            chart.set_xlabel(label, fontsize=8)
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle("Held-out quality against size; up and left is better", x=0.01, ha="left", fontsize=11)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor="white")
    return buffer.getvalue()


def _chart(chart: Any, methods: Mapping[str, Record], key: str, cost: str) -> None:
    forced = sorted((row for name, row in methods.items() if name.startswith("x")), key=lambda row: row[cost])
    front = find_pareto_front([(row[cost], row[key]) for row in methods.values()], MEASURES[key] > 0)
    chart.step(*zip(*front, strict=True), where="post", color="#7F7F7F", linestyle="--", linewidth=1, label="front")
    chart.plot(
        [row[cost] for row in forced], [row[key] for row in forced], "o-", color="#56B4E9", label="splatnode, forced"
    )
    marks = {SELF: ("*", "#D55E00", 150), PIXEL: ("s", "#000000", 45), RIVAL: ("^", "#009E73", 55)}
    names = {SELF: "splatnode, chosen", PIXEL: "a Gaussian a pixel", RIVAL: "MCMC, of that size"}
    for name, (marker, colour, size) in marks.items():
        if name in methods:
            row = methods[name]
            chart.scatter(row[cost], row[key], s=size, marker=marker, c=colour, zorder=3, label=names[name])
    chart.set_xscale("log")
    chart.xaxis.set_minor_formatter(NullFormatter())  # its numbers would lie on each other
    if MEASURES[key] < 0:
        chart.invert_yaxis()
    chart.tick_params(labelsize=7)
    chart.grid(color="#E4E4E4", linewidth=0.7)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("json", type=Path)
    parser.add_argument("png", type=Path)
    arguments = parser.parse_args()
    rows = json.loads(arguments.json.read_text())["rows"]
    print(json.dumps(summary(rows), indent=1))
    arguments.png.write_bytes(draw(rows))


if __name__ == "__main__":
    main()
