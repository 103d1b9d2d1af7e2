"""The benchmark: every method on every scene, each run in a process of its own."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec

from splatnode.capture.frame import Frame
from splatnode.recon.config import Config
from splatnode.recon.evaluate.appearance import Rasterize
from splatnode.recon.evaluate.process import call_alone, run_alone
from splatnode.recon.evaluate.protocol import STAGES, Networks, Poses, Row, Run, Settings, evaluate, ignore_render
from splatnode.recon.evaluate.records import Bench, bench_files, read_bench, run_of, this_machine
from splatnode.recon.evaluate.regions import Counts
from splatnode.recon.evaluate.renders import Renders
from splatnode.recon.evaluate.report import report_files
from splatnode.recon.evaluate.shown import Surface, shown_counts, surfaces
from splatnode.recon.evaluate.splits import Split, load_split
from splatnode.recon.evaluate.start import Start, find_start
from splatnode.recon.evaluate.truth import EvaluationScene, load_scene
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.snapshot import Snapshot

# Photographs, a method's name, a seed and what it may start from; it is sent to another process.
Reconstruct = Callable[[Sequence[Frame], str, int, Start | None], Iterator[Snapshot]]

_SHOWN = 3  # test views of each run whose renders are kept

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """What is run. `checkpoints` are iterations at which a run is scored on its way, besides its end."""

    scenes: tuple[Path, ...]
    views: tuple[int, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)
    checkpoints: tuple[int, ...] = ()
    timeout_s: float = 3600.0  # of one run


@dataclass(frozen=True)
class Entrants:
    """How methods are run. Those whose `start_of` is equal share cameras and points; None: it finds its own."""

    reconstruct: Reconstruct
    start_of: Callable[[str], Config | None]


@dataclass(frozen=True)
class Scoring:
    """How the snapshots of a run are scored."""

    rasterize: Rasterize
    networks: Networks
    settings: Settings
    by_region: bool = False  # also of what two training photographs show, one, or none (shown.py)


def run_bench(
    plan: Plan,
    entrants: Entrants,
    out_dir: Path,
    *,
    scoring: Scoring,
    command: str,
    resume: bool = False,
) -> Bench:
    """Runs the plan and returns all that `out_dir` then holds; with `resume`, runs that it holds are not run again.

    bench.json, bench.csv and the reports are rewritten after every run, so an interrupted benchmark keeps what it has
    measured. Cameras and points that several methods start from are found once for each set of photographs and seed;
    their seconds count in each method's total.
    A run that fails, or exceeds the time, becomes a row with the verdict "FAILED" and the reason. Raises ValueError or
    FileNotFoundError for a scene or split that is not there, before anything is run.
    """
    sets = [
        (scene, load_split(folder, list(scene.cameras), views))
        for scene, folder, views in ((load_scene(f), f, v) for f, v in itertools.product(plan.scenes, plan.views))
    ]
    known = read_bench(out_dir / "bench.json") if resume and (out_dir / "bench.json").exists() else None
    if known is not None and known.settings != scoring.settings:
        raise ValueError(f"{out_dir} holds views that were scored with {known.settings}: resume into another folder")
    if known is not None and command not in known.command:
        command = f"{known.command}; {command}"
    bench = Bench(() if known is None else known.rows, scoring.settings, this_machine(), command)
    finished, started = bench.done(), time.monotonic()
    seen = _Seen(scoring.settings.longer_side)
    jobs = [
        (scene, split, seed, [m for m in plan.methods if (scene.name, len(split.train), m, seed) not in finished])
        for (scene, split), seed in itertools.product(sets, plan.seeds)
    ]
    total, number = sum(len(methods) for *_, methods in jobs), 0
    for scene, split, seed, methods in (job for job in jobs if job[-1]):
        starts = _Starts(entrants.start_of, scene.frames(split.train), seed, plan.timeout_s)
        shown = seen.counts(scene, split) if scoring.by_region else {}
        for method in methods:
            number += 1
            rows = _run(plan, entrants.reconstruct, starts, scene, split, method, out_dir, scoring, shown)
            bench = msgspec.structs.replace(bench, rows=(*bench.rows, *rows))
            write_files(out_dir, bench_files(bench) | report_files(bench, out_dir))
            left = (time.monotonic() - started) / number * (total - number)
            logger.info("bench %d/%d, about %.0f min left: %s", number, total, left / 60, run_line(rows[-1]))
    return bench


class _Starts:
    """What the methods start from on one set of photographs, found when the first of them asks for it."""

    def __init__(
        self, start_of: Callable[[str], Config | None], frames: Sequence[Frame], seed: int, timeout_s: float
    ) -> None:
        self.frames, self.seed = frames, seed
        self._start_of, self._timeout_s = start_of, timeout_s
        self._found: list[tuple[Config, Start]] = []

    def of(self, method: str) -> Start | None:
        """Raises RuntimeError where it cannot be found."""
        wanted = self._start_of(method)
        if wanted is None:
            return None
        for config, start in self._found:
            if config == wanted:
                return start
        seeded = msgspec.structs.replace(wanted, seed=self.seed)
        start = call_alone(partial(find_start, self.frames, seeded), self._timeout_s)
        self._found.append((wanted, start))
        return start


class _Seen:
    """What the photographs of a scene see, by its true cameras, found once for all its sets of photographs."""

    def __init__(self, longer_side: int) -> None:
        self._longer_side = longer_side
        self._scene, self._surfaces = "", dict[str, Surface]()

    def counts(self, scene: EvaluationScene, split: Split) -> dict[str, Counts]:
        """By test view, how many training photographs show each pixel."""
        if scene.name != self._scene:
            self._scene, self._surfaces = scene.name, surfaces(scene, self._longer_side)
        training = [self._surfaces[name] for name in split.train if name in self._surfaces]
        return {n: shown_counts(self._surfaces[n], training) for n in split.test if n in self._surfaces}


def _run(
    plan: Plan,
    reconstruct: Reconstruct,
    starts: _Starts,
    scene: EvaluationScene,
    split: Split,
    method: str,
    out_dir: Path,
    scoring: Scoring,
    seen: Mapping[str, Counts],
) -> list[Row]:
    """The rows of one run: its checkpoints and its end, or its failure."""
    seed, views = starts.seed, len(split.train)
    try:
        start = starts.of(method)
    except RuntimeError as error:
        return [_failed_row(scene, views, method, seed, str(error))]
    work = partial(reconstruct, starts.frames, method, seed, start)
    outcome = run_alone(work, plan.checkpoints, plan.timeout_s, 0.0 if start is None else start.seconds)
    kept = Renders(out_dir, scene.name, views, method, seed, split.test[:: max(1, len(split.test) // _SHOWN)][:_SHOWN])
    poses: Poses = {}
    rows: list[Row] = []
    for moment in reversed(outcome.snapshots):  # the end first: from its test poses the search goes on for the others
        peaks = [peak for peak in (moment.peak_rss_mb, start and start.peak_rss_mb) if peak is not None]
        run = Run(method, seed, moment.checkpoint, moment.seconds, max(peaks, default=None))
        shown, networks = kept.keep, scoring.networks
        if moment.checkpoint is not None:
            shown, networks = ignore_render, networks.quickest
        row = evaluate(
            moment.snapshot,
            scene,
            split,
            run,
            rasterize=scoring.rasterize,
            networks=networks,
            settings=scoring.settings,
            show=shown,
            found=poses,
            shown=seen,
        )
        rows.insert(0, row)
    return rows if outcome.error is None else [*rows, _failed_row(scene, views, method, seed, outcome.error)]


def _failed_row(scene: EvaluationScene, views: int, method: str, seed: int, error: str) -> Row:
    return Row(
        scene=scene.name,
        views=views,
        method=method,
        seed=seed,
        checkpoint=None,
        final=True,
        seconds={**dict.fromkeys(STAGES), "total": None},
        peak_rss_mb=None,
        verdict="FAILED",
        error=error,
    )


def run_line(row: Row) -> str:
    """What a run scored and took, in one line of text."""
    scene, views, method, seed = run_of(row)
    score = "not scored" if row.psnr is None else f"{row.psnr:.2f} dB, {row.ssim:.3f} SSIM"
    seconds = row.seconds.get("total")
    took = "" if seconds is None else f", {seconds:.1f} s"
    return f"{scene} {views} views, {method}, seed {seed}: {row.verdict}, {score}{took}"
