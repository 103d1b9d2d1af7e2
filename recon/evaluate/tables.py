"""A benchmark's tables: ours, with what everything costs, and the paper's, in its form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import stdev

from splatnode.recon.evaluate import ablation
from splatnode.recon.evaluate.protocol import Row, mean
from splatnode.recon.evaluate.summary import MethodMean, method_means, shared


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


def lpips(rows: Sequence[Row]) -> Measure | None:
    """VGG's, as the field gives it, or AlexNet's where only that was measured."""
    if any(row.lpips_vgg is not None for row in rows):
        return Measure("LPIPS", lambda row: row.lpips_vgg, 4, False)
    if any(row.lpips_alex is not None for row in rows):
        return Measure("LPIPS (Alex)", lambda row: row.lpips_alex, 4, False)
    return None


def tables(rows: Sequence[Row]) -> list[Table]:
    """All that a report shows."""
    ends = [row for row in rows if row.final]
    compared = [row for row in ends if not ablation.is_variant(row.method)]
    counts = sorted({row.views for row in compared})
    overview = method_means(shared(compared))
    return [
        *(Table(f"{n} views", _HEAD, tuple(_cells(p) for p in overview if p.views == n)) for n in counts),
        *([by_views(shared(compared))] if compared else []),
        *(by_scene([row for row in compared if row.views == n], n) for n in counts),
        *([ablated(ends)] if len(compared) < len(ends) else []),
        Table("Runs", _RUN_HEAD, tuple(_run_cells(row) for row in ends)),
    ]


def by_views(ends: Sequence[Row]) -> Table:
    """The paper's tables I and II: methods down, measures and numbers of views across; means over scenes."""
    counts = sorted({row.views for row in ends})
    measures = [m for m in (SSIM, lpips(ends), PSNR, _ATE, _CENTRES) if m is not None]
    body = []
    for method in dict.fromkeys(row.method for row in ends):
        mine = [[row for row in ends if row.method == method and row.views == count] for count in counts]
        body.append((method, *(over_seeds(rows, measure) for measure in measures for rows in mine)))
    head = ("method", *(f"{measure.name} {count}" for measure in measures for count in counts))
    title = "By number of views (ATE as InstantSplat's code computes it; centres: RMS error in % of their spread)"
    return Table(title, head, tuple(body))


def by_scene(ends: Sequence[Row], views: int) -> Table:
    """The paper's table III: measures and methods down, scenes across."""
    scenes = sorted({row.scene for row in ends})
    methods = list(dict.fromkeys(row.method for row in ends))
    body = []
    for measure in (m for m in (SSIM, PSNR, lpips(ends)) if m is not None):
        for method in methods:
            cells = (
                over_seeds([r for r in ends if r.method == method and r.scene == scene], measure) for scene in scenes
            )
            body.append((measure.name, method, *cells))
    return Table(f"Scene by scene, {views} views", ("measure", "method", *scenes), tuple(body))


def ablated(ends: Sequence[Row]) -> Table:
    """The paper's table IV: what each part brings to the base alone, and what the whole loses without it.

    Every difference is over the scenes, views and seeds in which both were measured.
    """
    measures = [m for m in (PSNR, SSIM, lpips(ends)) if m is not None]
    body = []
    for variant in ablation.variants({row.method for row in ends}):
        cells = [variant.method, variant.against]
        for measure in measures:
            changes = paired(ends, variant.method, variant.against, measure)
            change = mean(changes)
            own = mean([measure.value(row) for row in ends if row.method == variant.method])
            cells += [number(own, measure.digits), "–" if change is None else f"{change:+.{measure.digits}f}"]
        cells.append(str(len(paired(ends, variant.method, variant.against, PSNR))))
        body.append(tuple(cells))
    names = [name for measure in measures for name in (measure.name, "change")]
    return Table("Ablation", ("method", "against", *names, "runs"), tuple(body))


def paired(ends: Sequence[Row], method: str, against: str, measure: Measure) -> list[float]:
    """The method's value less the other's, in each run (scene, views, seed) that both have."""

    def measured(name: str) -> dict[tuple[str, int, int], float]:
        mine = {(r.scene, r.views, r.seed): measure.value(r) for r in ends if r.method == name}
        return {run: value for run, value in mine.items() if value is not None}

    others = measured(against)
    return [value - others[run] for run, value in measured(method).items() if run in others]


def over_seeds(rows: Sequence[Row], measure: Measure) -> str:
    """Mean over seeds of the mean over scenes, and the standard deviation between seeds where there are several."""
    seeds = sorted({row.seed for row in rows})
    values = [mean([measure.value(row) for row in rows if row.seed == seed]) for seed in seeds]
    measured = [value for value in values if value is not None]
    if len(measured) < 2:
        return number(mean(measured), measure.digits)
    return f"{number(mean(measured), measure.digits)} ± {number(stdev(measured), measure.digits)}"


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


def _cells(p: MethodMean) -> tuple[str, ...]:
    return (
        p.method,
        f"{p.solved}/{p.runs}",
        *(number(p.seconds, 1), number(p.psnr, 2), number(p.ssim, 4), number(p.lpips_alex, 4)),
        *(number(p.lpips_vgg, 4), number(p.rotation_error_deg, 2), number(p.centre_error_pct, 2)),
        *(number(p.focal_error_pct, 2), number(p.num_gaussians, 0), number(p.scene_megabytes, 1)),
        number(p.peak_rss_mb, 0),
    )


def _run_cells(row: Row) -> tuple[str, ...]:
    return (
        *(row.scene, str(row.views), row.method, str(row.seed), row.verdict),
        *(number(row.seconds["total"], 1), number(row.psnr, 2), number(row.psnr_with_rim, 2), number(row.ssim, 4)),
        *(number(row.rotation_error_deg, 2), number(row.num_gaussians, 0)),
    )


def number(value: float | None, digits: int) -> str:
    """With spaces between thousands; – where it was not measured."""
    return "–" if value is None else f"{value:,.{digits}f}".replace(",", " ")
