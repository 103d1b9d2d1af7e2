"""A benchmark's tables: ours, with what everything costs, and the paper's, in its form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import stdev

from splatnode.recon.evaluate import ablation
from splatnode.recon.evaluate.protocol import Row, compute_mean
from splatnode.recon.evaluate.summary import MethodMean, compute_method_means, select_shared_runs


@dataclass(frozen=True)
class Table:
    title: str
    head: tuple[str, ...]
    body: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Measure:
    name: str
    value: Callable[[Row], float | None]
    digits: int
    higher_is_better: bool


PSNR = Measure("PSNR", lambda row: row.psnr, 2, True)
SSIM = Measure("SSIM", lambda row: row.ssim, 4, True)
_ATE = Measure("ATE", lambda row: row.ate_instantsplat, 4, False)
_CENTRES = Measure("centres %", lambda row: row.centre_error_pct, 2, False)


def select_lpips(rows: Sequence[Row]) -> Measure | None:
    """VGG's, as the field gives it, or AlexNet's where only that was measured."""
    if any(row.lpips_vgg is not None for row in rows):
        return Measure("LPIPS", lambda row: row.lpips_vgg, 4, False)
    if any(row.lpips_alex is not None for row in rows):
        return Measure("LPIPS (Alex)", lambda row: row.lpips_alex, 4, False)
    return None


def make_tables(rows: Sequence[Row]) -> list[Table]:
    """All that a report shows."""
    ends = [row for row in rows if row.final]
    compared = [row for row in ends if not ablation.is_variant(row.method)]
    counts = sorted({row.views for row in compared})
    overview = compute_method_means(select_shared_runs(compared))
    return [
        *(Table(f"{n} views", _HEAD, tuple(_format_cells(p) for p in overview if p.views == n)) for n in counts),
        *([make_views_table(select_shared_runs(compared))] if compared else []),
        *(make_scene_table([row for row in compared if row.views == n], n) for n in counts),
        *([make_ablation_table(ends)] if len(compared) < len(ends) else []),
        Table("Runs", _RUN_HEAD, tuple(_format_run_cells(row) for row in ends)),
    ]


def make_views_table(ends: Sequence[Row]) -> Table:
    """The paper's tables I and II: methods down, measures and numbers of views across; means over scenes."""
    counts = sorted({row.views for row in ends})
    measures = [m for m in (SSIM, select_lpips(ends), PSNR, _ATE, _CENTRES) if m is not None]
    body = []
    for method in dict.fromkeys(row.method for row in ends):
        mine = [[row for row in ends if row.method == method and row.views == count] for count in counts]
        body.append((method, *(format_seed_mean(rows, measure) for measure in measures for rows in mine)))
    head = ("method", *(f"{measure.name} {count}" for measure in measures for count in counts))
    title = "By number of views (ATE as InstantSplat's code computes it; centres: RMS error in % of their spread)"
    return Table(title, head, tuple(body))


def make_scene_table(ends: Sequence[Row], views: int) -> Table:
    """The paper's table III: measures and methods down, scenes across."""
    scenes = sorted({row.scene for row in ends})
    methods = list(dict.fromkeys(row.method for row in ends))
    body = []
    for measure in (m for m in (SSIM, PSNR, select_lpips(ends)) if m is not None):
        for method in methods:
            cells = (
                format_seed_mean([r for r in ends if r.method == method and r.scene == scene], measure)
                for scene in scenes
            )
            body.append((measure.name, method, *cells))
    return Table(f"Scene by scene, {views} views", ("measure", "method", *scenes), tuple(body))


def make_ablation_table(ends: Sequence[Row]) -> Table:
    """The paper's table IV: what each part brings to the base alone, and what the whole loses without it.

    Every difference is over the scenes, views and seeds in which both were measured.
    """
    measures = [m for m in (PSNR, SSIM, select_lpips(ends)) if m is not None]
    body = []
    for variant in ablation.list_variants({row.method for row in ends}):
        cells = [variant.method, variant.against]
        for measure in measures:
            changes = compute_paired_changes(ends, variant.method, variant.against, measure)
            change = compute_mean(changes)
            own = compute_mean([measure.value(row) for row in ends if row.method == variant.method])
            cells += [format_number(own, measure.digits), "–" if change is None else f"{change:+.{measure.digits}f}"]
        cells.append(str(len(compute_paired_changes(ends, variant.method, variant.against, PSNR))))
        body.append(tuple(cells))
    names = [name for measure in measures for name in (measure.name, "change")]
    return Table("Ablation", ("method", "against", *names, "runs"), tuple(body))


def compute_paired_changes(ends: Sequence[Row], method: str, against: str, measure: Measure) -> list[float]:
    """The method's value less the other's, in each run (scene, views, seed) that both have."""

    def collect_values(name: str) -> dict[tuple[str, int, int], float]:
        mine = {(r.scene, r.views, r.seed): measure.value(r) for r in ends if r.method == name}
        return {run: value for run, value in mine.items() if value is not None}

    others = collect_values(against)
    return [value - others[run] for run, value in collect_values(method).items() if run in others]


def format_seed_mean(rows: Sequence[Row], measure: Measure) -> str:
    """Mean over seeds of the mean over scenes, and the standard deviation between seeds where there are several."""
    seeds = sorted({row.seed for row in rows})
    values = [compute_mean([measure.value(row) for row in rows if row.seed == seed]) for seed in seeds]
    measured = [value for value in values if value is not None]
    if len(measured) < 2:
        return format_number(compute_mean(measured), measure.digits)
    return f"{format_number(compute_mean(measured), measure.digits)} ± {format_number(stdev(measured), measure.digits)}"


_HEAD = (
    *("method", "published", "seconds", "PSNR dB", "SSIM", "LPIPS Alex", "LPIPS VGG"),
    *("rotation °", "centre %", "focal %", "Gaussians", "MB", "peak RSS MB"),
)
_RUN_HEAD = (
    "scene",
    "views",
    "method",
    "seed",
    "verdict",
    "seconds",
    "PSNR dB",
    "with rim",
    "SSIM",
    "rotation °",
    "Gaussians",
)


def _format_cells(p: MethodMean) -> tuple[str, ...]:
    return (
        p.method,
        f"{p.solved}/{p.runs}",
        *(
            format_number(p.seconds, 1),
            format_number(p.psnr, 2),
            format_number(p.ssim, 4),
            format_number(p.lpips_alex, 4),
        ),
        *(format_number(p.lpips_vgg, 4), format_number(p.rotation_error_deg, 2), format_number(p.centre_error_pct, 2)),
        *(format_number(p.focal_error_pct, 2), format_number(p.num_gaussians, 0), format_number(p.scene_megabytes, 1)),
        format_number(p.peak_rss_mb, 0),
    )


def _format_run_cells(row: Row) -> tuple[str, ...]:
    return (
        *(row.scene, str(row.views), row.method, str(row.seed), row.verdict),
        *(
            format_number(row.seconds["total"], 1),
            format_number(row.psnr, 2),
            format_number(row.psnr_with_rim, 2),
            format_number(row.ssim, 4),
        ),
        *(format_number(row.rotation_error_deg, 2), format_number(row.num_gaussians, 0)),
    )


def format_number(value: float | None, digits: int) -> str:
    """Formats a number with spaces between thousands; – where it was not measured."""
    return "–" if value is None else f"{value:,.{digits}f}".replace(",", " ")
