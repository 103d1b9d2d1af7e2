"""A benchmark for people to read: report.md, and report.html with charts and with renders beside their photographs."""

from __future__ import annotations

import csv
import dataclasses
import html
import io
import logging
import math
import os
import platform
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import sqrt
from pathlib import Path
from statistics import stdev, variance
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np
from torch import Tensor

from splatnode.capture.image_file import encode_jpeg
from splatnode.capture.process.text import cell, escape_text
from splatnode.extras.evaluate import methods as evaluate_methods
from splatnode.extras.evaluate.dataset import Split, read_json
from splatnode.extras.evaluate.methods import is_variant
from splatnode.extras.evaluate.protocol import EXPOSURES, FAILED, Row, Settings, compute_mean
from splatnode.extras.jobs import ALONE, Moment, now, others_share
from splatnode.recon.config import PRESETS
from splatnode.recon.core import instruction_sets
from splatnode.recon.result.export.staged import json_bytes, write_files
from splatnode.recon.result.report import collect_versions

# Renders of test views beside their photographs, as files that report.html shows.

FOLDER = "renders"
PHOTOGRAPH = "photograph.jpg"
_QUALITY = 90


@dataclass(frozen=True)
class Renders:
    """The renders of one run. The test views in `shown` are files, by path in the benchmark's folder."""

    scene: str
    views: int
    method: str
    seed: int
    shown: tuple[str, ...]
    files: dict[str, bytes] = field(default_factory=dict)

    def keep(self, name: str, truth: Tensor, image: Tensor) -> None:
        """A `extras.evaluate.protocol.Show`."""
        if name in self.shown:
            folder = f"{FOLDER}/{self.scene}-{self.views}/{Path(name).stem}"
            self.files[f"{folder}/{PHOTOGRAPH}"] = _encode_jpeg(truth)
            self.files[f"{folder}/{self.method}-{self.seed}.jpg"] = _encode_jpeg(image)


def find_renders(out_dir: Path, row: Row) -> dict[str, Path]:
    """The render of each kept test view, by the view's name, for the run that `row` ends; none if nothing was kept.

    Nor are there any of a run that was not scored: what lies there is of an earlier run.
    """
    if row.psnr is None:
        return {}
    found = (out_dir / FOLDER / f"{row.scene}-{row.views}").glob(f"*/{row.method}-{row.seed}.jpg")
    return {path.parent.name: path for path in sorted(found)}


def _encode_jpeg(image: Tensor) -> bytes:
    pixels = np.rint(image.numpy() * 255).astype(np.uint8)
    return encode_jpeg(pixels, _QUALITY)


# Rows as means over scenes and seeds: what the report's tables and the charts show.


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


# A benchmark's tables: ours, with what everything costs, and the paper's, in its form.


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
    compared = [row for row in ends if not evaluate_methods.is_variant(row.method)]
    counts = sorted({row.views for row in compared})
    overview = compute_method_means(select_shared_runs(compared))
    return [
        *(Table(f"{n} views", _HEAD, tuple(_format_table_cells(p) for p in overview if p.views == n)) for n in counts),
        *([make_views_table(select_shared_runs(compared))] if compared else []),
        *(make_scene_table([row for row in compared if row.views == n], n) for n in counts),
        *([make_exposure_table(compared)] if any(row.exposures for row in compared) else []),
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


def make_exposure_table(ends: Sequence[Row]) -> Table:
    """Means as the scenes show held-out views, with the gains that training views imply, and with the best gains."""
    shared = [row for row in select_shared_runs(ends) if row.exposures]
    body = []
    for views, method in sorted({(row.views, row.method) for row in shared}):
        rows = [row for row in shared if (row.views, row.method) == (views, method)]
        cells = [str(views), method]
        for name, digits in (("psnr", 2), ("ssim", 4)):
            means = [compute_mean([getattr(row.exposures[kind], name) for row in rows]) for kind in EXPOSURES]
            cells += [format_number(mean, digits) for mean in means]
        errors = [row.exposures["interpolated"].gain_error_pct for row in rows]
        body.append((*cells, format_number(compute_mean(errors), 1)))
    kinds = ("raw", "interpolated gains", "best gains")
    head = ("views", "method", *(f"{name}, {kind}" for name in ("PSNR", "SSIM") for kind in kinds), "gains off by, %")
    return Table("Exposure of held-out views", head, tuple(body))


def make_ablation_table(ends: Sequence[Row]) -> Table:
    """The paper's table IV: what each part brings to the base alone, and what the whole loses without it.

    Every difference is over the scenes, views and seeds in which both were measured.
    """
    measures = [m for m in (PSNR, SSIM, select_lpips(ends)) if m is not None]
    body = []
    for variant in evaluate_methods.list_variants({row.method for row in ends}):
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


def _format_table_cells(p: MethodMean) -> tuple[str, ...]:
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


# Case by case, ours against the best of the others, so that no mean hides a loss.

OURS = "balanced"


def _make_region_getter(region: str, name: str) -> Callable[[Row], float | None]:
    return lambda row: getattr(row.regions[region], name) if region in row.regions else None


LPIPS = Measure("LPIPS", lambda row: row.lpips_alex, 4, False)
WHOLE = (PSNR, SSIM, LPIPS)
SHOWN = (  # of the pixels that a training photograph shows
    Measure("PSNR shown", _make_region_getter("shown", "psnr"), 2, True),
    Measure("SSIM shown", _make_region_getter("shown", "ssim"), 4, True),
    Measure("LPIPS shown", _make_region_getter("shown", "lpips_alex"), 4, False),
)


@dataclass(frozen=True)
class Margin:
    """Our mean over seeds and that of the method that is best in this case and measure."""

    scene: str
    views: int
    measure: Measure
    ours: float
    best: float
    by: str
    error: float | None = None  # standard error of `lead`, as seeds have it; None: one of the two has a single seed

    @property
    def lead(self) -> float:
        """How much better ours is; below 0 where it is worse."""
        return (self.ours - self.best) * (1 if self.measure.higher_is_better else -1)


def compute_margins(ends: Sequence[Row], measure: Measure, ours: str = OURS) -> list[Margin]:
    """A margin for each set of photographs that ours and another method, no preset and no variant, were scored on."""
    found = []
    for scene, views in dict.fromkeys((row.scene, row.views) for row in ends):
        here = [row for row in ends if (row.scene, row.views) == (scene, views)]
        values = {
            method: [value for row in here if row.method == method and (value := measure.value(row)) is not None]
            for method in dict.fromkeys(row.method for row in here)
        }
        means = {method: compute_mean(found) for method, found in values.items()}
        others = {m: v for m, v in means.items() if v is not None and m not in PRESETS and not is_variant(m)}
        mine = means.get(ours)
        if mine is None or not others:
            continue
        by = (max if measure.higher_is_better else min)(others, key=lambda method: others[method])
        found.append(
            Margin(scene, views, measure, mine, others[by], by, _compute_standard_error(values[ours], values[by]))
        )
    return found


def _compute_standard_error(ours: Sequence[float], others: Sequence[float]) -> float | None:
    """Seeds of one method have nothing to do with those of another, so the variances of the means add up."""
    if min(len(ours), len(others)) < 2:
        return None
    return sqrt(sum(variance(values) / len(values) for values in (ours, others)))


def make_case_tables(ends: Sequence[Row]) -> list[Table]:
    """One of whole photographs, and one of what the training photographs show of them where that was measured."""
    tables = []
    for title, measures in (("whole held-out photographs", WHOLE), ("what training photographs show", SHOWN)):
        by_measure = {measure.name: compute_margins(ends, measure) for measure in measures}
        leads = {name: found for name, found in by_measure.items() if found}
        if leads:
            tables.append(_make_table(f"`{OURS}` against the best other in each case: {title}", leads))
    return tables


def _make_table(title: str, by_measure: dict[str, list[Margin]]) -> Table:
    names = list(by_measure)
    body = []
    for scene, views in dict.fromkeys((each.scene, each.views) for found in by_measure.values() for each in found):
        cells = [f"{scene} {views}"]
        for name in names:
            here = [each for each in by_measure[name] if (each.scene, each.views) == (scene, views)]
            cells += _format_cells(here[0]) if here else ["–", "–", "–"]
        body.append(tuple(cells))
    total = ["mean lead; cases no worse"]
    for name in names:
        leads = [each.lead for each in by_measure[name]]
        digits = by_measure[name][0].measure.digits
        total += [
            f"{sum(lead >= 0 for lead in leads)} of {len(leads)}",
            "",
            f"{compute_mean(leads) or 0.0:+.{digits}f}",
        ]
    head = ("set", *(cell for name in names for cell in (name, "best other", "lead")))
    return Table(title, head, (*body, tuple(total)))


def _format_cells(margin: Margin) -> list[str]:
    digits = margin.measure.digits
    return [
        format_number(margin.ours, digits),
        f"{format_number(margin.best, digits)} {margin.by}",
        f"{margin.lead:+.{digits}f}",
    ]


# What a run was timed on, and whether its seconds are worth telling: only where it had its cores alone.


@dataclass(frozen=True)
class Timing:
    cores: int  # that the run could use
    processor: str
    others: float | None  # the share of their time that others took while the clock ran; None: nobody can tell

    @property
    def is_alone(self) -> bool:
        return had_alone(self.others)


def measure_timing(since: Moment) -> Timing:
    """Measures the timing of this process since then."""
    return Timing(len(since.cores), describe_processor(), others_share(since, now()))


def had_alone(others: float | None) -> bool:
    """Whether seconds are reported of a run during which others took this share of its cores."""
    return others is None or others <= ALONE


def find_largest_share(timings: Iterable[Timing | None]) -> float | None:
    """The largest share that others took in any of these; None: nobody can tell of any."""
    shares = [timed.others for timed in timings if timed is not None]
    return max((share for share in shares if share is not None), default=None)


def explain_missing_seconds(others: Collection[float | None]) -> str:
    """A sentence for runs of which others took these shares of the cores; empty where all were alone."""
    disturbed = sum(not had_alone(share) for share in others)
    if not disturbed:
        return ""
    return (
        f"seconds are not reported of {disturbed} of {len(others)} runs: others took more than {ALONE:.0%} of the time "
        "of their cores"
    )


def check_same_cores(known: Collection[int], each: int, where: Path) -> None:
    """Raises ValueError where `where` holds runs on `known` numbers of cores and the next ones would have `each`."""
    if other := sorted(set(known) - {each}):
        raise ValueError(
            f"{where} holds runs that had {_format_cores(other[0])} each, now each would have {_format_cores(each)}, "
            "and their "
            "seconds would be mixed: give the same --cores as before, or another --out"
        )


def describe_processor() -> str:
    """The name of this machine's, with the instructions that the core uses: one name has several generations."""
    used = instruction_sets()[:1]
    return ", ".join([_read_processor_name(), *used])


def _read_processor_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _format_cores(number: int) -> str:
    return f"{number} core{'s' * (number != 1)}"


# bench.json: what a benchmark has measured, and on what. Everything that is drawn or told comes from it.


class Bench(msgspec.Struct, frozen=True):
    rows: tuple[Row, ...]
    settings: Settings
    machine: dict[str, Any]
    command: str
    # How runs are made, the same for all; None in files of older versions, which did not say so
    by_region: bool | None = None
    checkpoints: tuple[int, ...] | None = None
    device: str | None = None
    splits: dict[str, Split] = {}  # by `format_set_name`

    def final_runs(self) -> set[tuple[str, int, str, int]]:
        """The runs (scene, views, method, seed) that have come to their end, or failed."""
        return {make_run_key(row) for row in self.rows if row.final}

    def successful_runs(self) -> set[tuple[str, int, str, int]]:
        """Those that need not be run again: they have not failed."""
        return {make_run_key(row) for row in self.rows if row.final and row.verdict != FAILED}


def make_run_key(row: Row) -> tuple[str, int, str, int]:
    return row.scene, row.views, row.method, row.seed


def format_set_name(scene: str, views: int) -> str:
    return f"{scene}, {views} views"


def read_bench(path: Path) -> Bench:
    """Raises FileNotFoundError, or EvaluationFileError where the file holds something else."""
    return read_json(path, Bench, "the bench.json of a benchmark")


def merge_benches(benches: Sequence[Bench]) -> Bench:
    """The runs of several benchmarks, each run as the last of them has it. Raises ValueError if they scored otherwise.

    Machine and command are all that were named.
    """
    if len({bench.settings for bench in benches}) != 1:
        settings = [dataclasses.asdict(bench.settings) for bench in benches]
        raise ValueError(f"benchmarks can be put together if their views were scored alike, got settings {settings}")
    last = {run: number for number, bench in enumerate(benches) for run in bench.final_runs()}
    rows = tuple(
        row for number, bench in enumerate(benches) for row in bench.rows if last.get(make_run_key(row)) == number
    )
    machine = {key: value for bench in benches for key, value in bench.machine.items()}
    commands = dict.fromkeys(bench.command for bench in benches)
    common: dict[str, Any] = {}
    for name in ("by_region", "checkpoints", "device"):
        values = {getattr(bench, name) for bench in benches}
        common[name] = values.pop() if len(values) == 1 else None
    splits = {key: split for bench in benches for key, split in bench.splits.items()}
    return Bench(rows, benches[0].settings, machine, "; ".join(commands), **common, splits=splits)


def make_bench_files(bench: Bench) -> dict[str, bytes]:
    """bench.json and bench.csv."""
    rows = [dataclasses.asdict(row) for row in bench.rows]  # msgspec leaves out what an older file did not have
    content = {
        "rows": rows,
        "settings": dataclasses.asdict(bench.settings),
        "machine": bench.machine,
        "command": bench.command,
        "by_region": bench.by_region,
        "checkpoints": bench.checkpoints,
        "device": bench.device,
        "splits": {key: dataclasses.asdict(split) for key, split in bench.splits.items()},
    }
    return {"bench.json": json_bytes(content), "bench.csv": _format_csv(rows)}


def describe_machine() -> dict[str, Any]:
    """Describes the machine on which the seconds were measured."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": describe_processor(), "threads": affinity, **collect_versions()}


def _format_csv(records: Sequence[Mapping[str, Any]]) -> bytes:
    """The rows with their seconds, regions and exposures as columns of their own; empty where not measured."""
    flat = []
    for record in records:
        seconds = {f"seconds_{stage}": value for stage, value in record["seconds"].items()}
        regions = {
            f"{region}_{measure}": value
            for region, scores in record["regions"].items()
            for measure, value in scores.items()
        }
        exposures = {
            f"{exposure}_{measure}": value
            for exposure, scores in record["exposures"].items()
            for measure, value in scores.items()
        }
        plain = {name: value for name, value in record.items() if name not in ("seconds", "regions", "exposures")}
        flat.append(plain | seconds | regions | exposures)
    text = io.StringIO()
    columns = dict.fromkeys(name for row in flat for name in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: cell(value) for name, value in row.items()} for row in flat)
    return text.getvalue().encode()


logger = logging.getLogger(__name__)

_STARTS = {"true": "the true pose", "interpolated": "between the neighbouring cameras"}
_GAINS = {
    False: ", in the exposure that the training views around imply there",
    True: ", in the exposure and white balance of each held-out photograph",
}
_STYLE = (
    "body{font:15px/1.45 sans-serif;margin:2em auto;max-width:1500px;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0;display:block;overflow-x:auto}td,th{border-bottom:1px solid #ddd;"
    "padding:.25em .7em;text-align:right;white-space:nowrap}td:first-child,th:first-child{text-align:left}"
    "img{max-width:100%}figure{display:inline-block;width:23%;margin:.4em}figcaption{font-size:13px;color:#666}"
)


def make_report_files(bench: Bench, out_dir: Path) -> dict[str, bytes]:
    """report.md and report.html; the latter shows the charts and renders that lie in `out_dir`."""
    found = [*make_case_tables([row for row in bench.rows if row.final]), *make_tables(bench.rows)]
    return {
        "report.md": _format_markdown(bench, found).encode(),
        "report.html": _format_html(bench, found, out_dir).encode(),
    }


def redraw(bench: Bench, out_dir: Path) -> None:
    """Everything that can be made of bench.json: the file itself, as CSV, the charts and both reports."""
    write_files(out_dir, make_bench_files(bench) | _draw_charts(bench))
    write_files(out_dir, make_report_files(bench, out_dir))


def _draw_charts(bench: Bench) -> dict[str, bytes]:
    """Those that there are numbers for; none without matplotlib to draw them."""
    try:
        from splatnode.extras.evaluate import charts as evaluate_charts
    except ImportError:
        logger.warning("no charts: matplotlib is not installed. Run: pip install 'splatnode[bench]'")
        return {}
    drawn = evaluate_charts.draw(bench.rows) | evaluate_charts.draw_case_charts(bench.rows)
    if not drawn:
        logger.warning("no charts: no run published a scene that could be scored")
    return drawn


def _format_introduction(bench: Bench) -> str:
    machine, settings = bench.machine, bench.settings
    return (
        f"Machine: {machine.get('processor')}, {machine.get('threads')} threads. Held-out views are scored after their "
        f"pose was found in the finished scene ({settings.alignment_steps} steps from {_STARTS[settings.start]}, "
        "equation 18), at "
        f"{settings.longer_side} px, without the black rim that undistortion left (`with rim`: PSNR of the whole "
        f"photograph){_GAINS[settings.best_gain]}. "
        "Seconds are wall time of the reconstruction alone, with the cameras and points that methods of "
        "one prior share; of runs that did not have their cores alone, or had other cores than the rest, there are "
        "none. Means are over the runs that every method was put to and, of these, the method's that "
        "published a scene; `±`: standard deviation "
        "between seeds; `–`: not measured."
    )


def _format_markdown(bench: Bench, found: Sequence[Table]) -> str:
    lines = [
        "# Benchmark",
        "",
        f"Command: `{escape_text(bench.command)}`",
        "",
        escape_text(_format_introduction(bench)),
    ]
    for table in found:
        head, *body = ([_escape_cell(cell) for cell in row] for row in (table.head, *table.body))
        rows = (head, ["---"] * len(head), *body)
        lines += ["", f"## {table.title}", "", *(f"| {' | '.join(row)} |" for row in rows)]
    return "\n".join(lines) + "\n"


def _escape_cell(raw: str) -> str:
    return escape_text(raw).replace("|", "\\|").replace("<", "&lt;")


def _format_html(bench: Bench, found: Sequence[Table], out_dir: Path) -> str:
    charts = [path.name for path in sorted(out_dir.glob("*.png"))]
    parts = [
        f"<h1>Benchmark</h1><p><code>{_escape_text(bench.command)}</code></p><p>{_escape_text(_format_introduction(bench))}</p>",
        *(f'<p><img src="{_quote_path(name)}" alt="{_escape_text(name)}"></p>' for name in charts),
        *(_format_html_table(table) for table in found),
        *_format_galleries([row for row in bench.rows if row.final], out_dir),
    ]
    head = f'<meta charset="utf-8"><title>Benchmark</title><style>{_STYLE}</style>'
    return f"<!DOCTYPE html><html><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def _format_html_table(table: Table) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return f"<tr>{''.join(f'<{tag}>{_escape_text(cell)}</{tag}>' for cell in cells)}</tr>"

    body = "".join(line(row, "td") for row in table.body)
    return f"<h2>{_escape_text(table.title)}</h2><table>{line(table.head, 'th')}{body}</table>"


def _format_galleries(ends: Sequence[Row], out_dir: Path) -> list[str]:
    """For each set of photographs and each kept test view: the photograph, then every run's render of it."""
    parts = []
    for scene, views in dict.fromkeys((row.scene, row.views) for row in ends):
        shown: dict[str, list[str]] = {}
        for row in (row for row in ends if (row.scene, row.views) == (scene, views)):
            for view, path in find_renders(out_dir, row).items():
                photograph = _format_figure(path.parent / PHOTOGRAPH, f"{view}: photograph", out_dir)
                caption = f"{row.method}, seed {row.seed}: {format_number(row.psnr, 2)} dB over all views"
                shown.setdefault(view, [photograph]).append(_format_figure(path, caption, out_dir))
        if shown:
            parts.append(f"<h2>{_escape_text(scene)}, {views} views</h2>")
            parts += [f"<div>{''.join(figures)}</div>" for figures in shown.values()]
    return parts


def _format_figure(path: Path, caption: str, out_dir: Path) -> str:
    source = _quote_path(os.path.relpath(path, out_dir).replace(os.sep, "/"))
    return f'<figure><img src="{source}" loading="lazy"><figcaption>{_escape_text(caption)}</figcaption></figure>'


def _escape_text(raw: str) -> str:
    """Escapes a name for a page: neither markup nor a character that does more than show."""
    return html.escape(escape_text(raw))


def _quote_path(path: str) -> str:
    """A file's name as an address relative to the page; no byte of it is markup, a scheme or a question."""
    return quote(os.fsencode(path))
