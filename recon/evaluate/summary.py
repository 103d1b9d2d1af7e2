"""Rows as means over scenes and seeds: what the report's tables and the charts show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from splatnode.recon.evaluate.protocol import Row, compute_mean


@dataclass(frozen=True)
class MethodMean:
    """A method at a checkpoint or its end: means over its published runs, None where one of them was not measured."""

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


def select_shared_runs(rows: Sequence[Row]) -> list[Row]:
    """Selects, for each number of views, the runs (scene, seed) that every method has; all if none are.

    Means over different scenes say more about the scenes than about the methods.
    """
    runs: dict[int, dict[str, set[tuple[str, int]]]] = {}
    for row in rows:
        runs.setdefault(row.views, {}).setdefault(row.method, set()).add((row.scene, row.seed))
    common = {views: set.intersection(*methods.values()) for views, methods in runs.items()}
    return [row for row in rows if not common[row.views] or (row.scene, row.seed) in common[row.views]]


def compute_method_means(rows: Sequence[Row]) -> list[MethodMean]:
    """One MethodMean for each (views, method, checkpoint), in the order of the benchmark; ends come after checkpoints.

    A run that ended before a checkpoint counts there with its end: every point of a curve is over the same runs.
    """
    groups: dict[tuple[int, str], dict[tuple[str, int], list[Row]]] = {}
    for row in rows:
        runs = groups.setdefault((row.views, row.method), {})
        runs.setdefault((row.scene, row.seed), []).append(row)
    found = []
    for (views, method), runs in sorted(groups.items(), key=lambda item: item[0][0]):
        for moment in sorted({_compute_moment(row) for run in runs.values() for row in run}):
            chosen = [_select_row_at(run, moment) for run in runs.values()]
            found.append(_compute_method_mean(views, method, None if moment == math.inf else int(moment), chosen))
    return found


def _compute_moment(row: Row) -> float:
    """The checkpoint's iterations; infinite for the end of a run."""
    return math.inf if row.checkpoint is None else row.checkpoint


def _select_row_at(run: Sequence[Row], moment: float) -> Row:
    """The run's first row at or beyond a moment; its latest where the run broke off before."""
    beyond = [row for row in run if _compute_moment(row) >= moment]
    return min(beyond, key=_compute_moment) if beyond else max(run, key=_compute_moment)


def _is_same_hardware(rows: Sequence[Row]) -> bool:
    """Whether all ran on processors of one kind, on as many cores each: else a mean of their seconds says nothing."""
    return len({(row.processor, row.cores) for row in rows}) <= 1


def _compute_method_mean(views: int, method: str, checkpoint: int | None, rows: Sequence[Row]) -> MethodMean:
    """Seconds, Gaussians and bytes are those of the published runs, like the quality that they bought."""
    solved = [row for row in rows if row.psnr is not None]

    def average_all(values: Sequence[float | None]) -> float | None:
        return None if None in values else compute_mean(values)

    scene_bytes = average_all([row.scene_bytes for row in solved])
    names = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "num_gaussians", "peak_rss_mb")
    poses = ("rotation_error_deg", "centre_error_pct", "focal_error_pct")
    return MethodMean(
        views,
        method,
        checkpoint,
        runs=len(rows),
        solved=len(solved),
        seconds=average_all([row.seconds.get("total") for row in solved]) if _is_same_hardware(solved) else None,
        scene_megabytes=None if scene_bytes is None else scene_bytes / 1e6,
        **{name: average_all([getattr(row, name) for row in solved]) for name in (*names, *poses)},
    )
