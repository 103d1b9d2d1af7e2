"""bench.json as means over scenes and seeds: what the report's tables and the charts show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Point:
    """One method at one moment: means over the runs in which a value was measured, None where it never was."""

    views: int
    method: str
    checkpoint: int | None  # None: the end of the run
    runs: int
    solved: int  # runs with a published scene
    seconds: float | None
    psnr: float | None
    ssim: float | None
    lpips_alex: float | None
    lpips_vgg: float | None
    rotation_error_deg: float | None
    centre_error_pct: float | None
    focal_error_pct: float | None
    num_gaussians: float | None
    scene_megabytes: float | None
    peak_rss_mb: float | None


def points(rows: Sequence[Mapping]) -> list[Point]:
    """One Point for each (views, method, checkpoint), in the order of the benchmark; ends come after checkpoints.

    A run that ended before a checkpoint counts there with its end: every point of a curve is over the same runs.
    """
    groups: dict[tuple[int, str], dict[tuple[str, int], list[Mapping]]] = {}
    for row in rows:
        runs = groups.setdefault((row["views"], row["method"]), {})
        runs.setdefault((row["scene"], row["seed"]), []).append(row)
    found = []
    for (views, method), runs in sorted(groups.items(), key=lambda item: item[0][0]):
        for moment in sorted({_moment(row) for run in runs.values() for row in run}):
            chosen = [_row_at(run, moment) for run in runs.values()]
            found.append(_point(views, method, None if moment == math.inf else int(moment), chosen))
    return found


def _moment(row: Mapping) -> float:
    """The checkpoint's iterations; infinite for the end of a run."""
    return math.inf if row["checkpoint"] is None else row["checkpoint"]


def _row_at(run: Sequence[Mapping], moment: float) -> Mapping:
    """The run's first row at or beyond a moment; its latest where the run broke off before."""
    beyond = [row for row in run if _moment(row) >= moment]
    return min(beyond, key=_moment) if beyond else max(run, key=_moment)


def _point(views: int, method: str, checkpoint: int | None, rows: Sequence[Mapping]) -> Point:
    """Seconds, Gaussians and bytes are those of the published runs, like the quality that they bought."""
    solved = [row for row in rows if row["psnr"] is not None]
    scene_bytes = _mean(solved, "scene_bytes")
    names = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "num_gaussians", "peak_rss_mb")
    poses = ("rotation_error_deg", "centre_error_pct", "focal_error_pct")
    return Point(
        views,
        method,
        checkpoint,
        runs=len(rows),
        solved=len(solved),
        seconds=_mean([row["seconds"] for row in solved], "total"),
        scene_megabytes=None if scene_bytes is None else scene_bytes / 1e6,
        **{name: _mean(solved, name) for name in names},
        **{name: _mean(solved, name) for name in poses},
    )


def _mean(rows: Sequence[Mapping], name: str) -> float | None:
    values = [row[name] for row in rows if row.get(name) is not None]
    return float(np.mean(values)) if values else None


def markdown(bench: Mapping) -> str:
    """report.md: a table a number of views, one line a method at its end, then every run."""
    rows = bench["rows"]
    machine = bench["machine"]
    lines = [
        "# Benchmark",
        "",
        f"Command: `{bench['command']}`",
        "",
        f"Machine: {machine.get('processor')}, {machine.get('threads')} threads. Held-out views are scored after their "
        f"pose was found in the finished scene ({bench['settings']['alignment_steps']} steps, equation 18), at "
        f"{bench['settings']['longer_side']} px. Seconds are wall time of the reconstruction alone. Means are over the "
        "runs that published a scene; `–`: not measured.",
    ]
    ends = [point for point in points(rows) if point.checkpoint is None]
    for views in sorted({point.views for point in ends}):
        lines += ["", f"## {views} views", "", *_table(_HEAD, [_cells(p) for p in ends if p.views == views])]
    lines += ["", "## Runs", "", *_table(_RUN_HEAD, [_run_cells(row) for row in rows if row["checkpoint"] is None])]
    return "\n".join(lines) + "\n"


_HEAD = (
    *("method", "published", "seconds", "PSNR dB", "SSIM", "LPIPS Alex", "LPIPS VGG"),
    *("rotation °", "centre %", "focal %", "Gaussians", "MB", "peak RSS MB"),
)
_RUN_HEAD = ("scene", "views", "method", "seed", "verdict", "seconds", "PSNR dB", "SSIM", "rotation °", "Gaussians")


def _cells(p: Point) -> list[str]:
    return [
        p.method,
        f"{p.solved}/{p.runs}",
        *(_number(p.seconds, 1), _number(p.psnr, 2), _number(p.ssim, 4), _number(p.lpips_alex, 4)),
        *(_number(p.lpips_vgg, 4), _number(p.rotation_error_deg, 2), _number(p.centre_error_pct, 2)),
        *(_number(p.focal_error_pct, 2), _number(p.num_gaussians, 0), _number(p.scene_megabytes, 1)),
        _number(p.peak_rss_mb, 0),
    ]


def _run_cells(row: Mapping) -> list[str]:
    return [
        *(row["scene"], str(row["views"]), row["method"], str(row["seed"]), row["verdict"]),
        *(_number(row["seconds"]["total"], 1), _number(row["psnr"], 2), _number(row["ssim"], 4)),
        *(_number(row["rotation_error_deg"], 2), _number(row["num_gaussians"], 0)),
    ]


def _table(head: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *body)]


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:,.{digits}f}".replace(",", " ")
