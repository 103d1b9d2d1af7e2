"""One run of a benchmark, in a process of its own: the reconstruction, and what it scores."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

from splatnode.capture.frame import Frame
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.evaluate.appearance import Rasterize
from splatnode.recon.evaluate.moments import RunMoment, run_to_end
from splatnode.recon.evaluate.perceptual import PerceptualNetworks
from splatnode.recon.evaluate.protocol import FAILED, STAGES, Poses, Row, Run, Settings, evaluate, ignore_render
from splatnode.recon.evaluate.regions import Counts
from splatnode.recon.evaluate.renders import Renders
from splatnode.recon.evaluate.shown import compute_surfaces, count_visibility_by_name
from splatnode.recon.evaluate.splits import Split
from splatnode.recon.evaluate.start import Start, find_start
from splatnode.recon.evaluate.timing import Timing, find_largest_share, had_alone, measure_timing
from splatnode.recon.evaluate.truth import EvaluationScene
from splatnode.recon.jobs.alone import now
from splatnode.recon.result.snapshot import Snapshot

# Photographs, a method's name, a seed and what it may start from; it is sent to another process.
Reconstruct = Callable[[Sequence[Frame], str, int, Start | None], Iterator[Snapshot]]
Seen = Mapping[int, Mapping[str, Counts]]  # by training views and test view: how many of those show each pixel

_SHOWN = 3  # test views of each run whose renders are kept


@dataclass(frozen=True)
class Scoring:
    """How the snapshots of a run are scored; it is sent to the run's process."""

    rasterize: Rasterize
    networks: Callable[[], PerceptualNetworks]  # loads them: a module's function, or a functools.partial of one
    settings: Settings
    by_region: bool = False  # also of what two training photographs show, one, or none (shown.py)


@dataclass(frozen=True, eq=False)
class Job:
    """A run. `timed`: False where its seconds would say nothing, as of several runs on one GPU."""

    scene: EvaluationScene
    split: Split
    method: str
    seed: int
    checkpoints: tuple[int, ...]
    reconstruct: Reconstruct
    scoring: Scoring
    timed: bool = True


@dataclass(frozen=True, eq=False)
class RunResult:
    """The result of a run: its checkpoints and end, or its failure, and renders by `renders.Renders`."""

    rows: list[Row]
    renders: Mapping[str, bytes]


@dataclass(frozen=True, eq=False)
class TimedStart:
    start: Start
    timed_on: Timing


def time_start(scene: EvaluationScene, split: Split, config: ReconstructionConfig) -> TimedStart:
    """Cameras and points that several methods start from."""
    frames, since = scene.frames(split.train), now()
    start = find_start(frames, config)
    return TimedStart(start, measure_timing(since))


def compute_visibility_by_split(scene: EvaluationScene, splits: Sequence[Split], longer_side: int) -> Seen:
    """Counts which training images of each split show its test views, by the true cameras."""
    found = compute_surfaces(scene, longer_side)
    counts = {}
    for split in splits:
        training = [found[name] for name in split.train if name in found]
        counts[len(split.train)] = count_visibility_by_name(split.test, found, training)
    return counts


def run_and_score(job: Job, start: bytes | None, shown: bytes | None) -> RunResult:
    """Runs `job`, from the pickled `time_start`, if there is one, and scores it; `shown` is the pickled `seen`."""
    begun: TimedStart | None = pickle.loads(start) if start else None
    counts: Mapping[str, Counts] = pickle.loads(shown)[len(job.split.train)] if shown else {}
    frames = job.scene.frames(job.split.train)
    work = partial(job.reconstruct, frames, job.method, job.seed, begun and begun.start)
    outcome = run_to_end(work, job.checkpoints, begun.start.seconds if begun else 0.0)
    names = job.split.test[:: max(1, len(job.split.test) // _SHOWN)][:_SHOWN]
    renders = Renders(job.scene.name, len(job.split.train), job.method, job.seed, names)
    networks = job.scoring.networks()
    poses: Poses = {}
    rows: list[Row] = []
    for moment in reversed(outcome.moments):  # the end first: from its test poses the search goes on for the others
        at_the_end = moment.checkpoint is None
        row = evaluate(
            moment.snapshot,
            job.scene,
            job.split,
            _make_run(job, moment, begun),
            rasterize=job.scoring.rasterize,
            networks=networks if at_the_end else networks.quickest,
            settings=job.scoring.settings,
            show=renders.keep if at_the_end else ignore_render,
            found=poses,
            shown=counts,
        )
        rows.insert(0, _add_timing(row, job, moment, begun))
    rows = rows if outcome.error is None else [*rows, make_failed_row(job, outcome.error)]
    return RunResult(_truncate_at_non_finite(rows, job), renders.files)


def _truncate_at_non_finite(rows: Sequence[Row], job: Job) -> list[Row]:
    """The rows; up to the first one with a number that is not finite, as of a run that broke off there, if there is."""
    for index, row in enumerate(rows):
        if measure := _find_non_finite(row):
            when = "the end" if row.checkpoint is None else f"iteration {row.iterations}"
            return [*rows[:index], make_failed_row(job, f"{measure} is not finite at {when}")]
    return list(rows)


def _find_non_finite(row: Row) -> str:
    """The first of the row's measures that no JSON file can hold; empty where there is none."""
    for name, value in asdict(row).items():
        try:
            json.dumps(value, allow_nan=False)
        except ValueError:
            return name
    return ""


def make_failed_row(job: Job, error: str) -> Row:
    return Row(
        scene=job.scene.name,
        views=len(job.split.train),
        method=job.method,
        seed=job.seed,
        checkpoint=None,
        final=True,
        seconds={**dict.fromkeys(STAGES), "total": None},
        peak_rss_mb=None,
        verdict=FAILED,
        error=error,
    )


def _make_run(job: Job, moment: RunMoment, begun: TimedStart | None) -> Run:
    peaks = [peak for peak in (moment.peak_rss_mb, begun and begun.start.peak_rss_mb) if peak is not None]
    return Run(job.method, job.seed, moment.checkpoint, moment.seconds, max(peaks, default=None))


def _add_timing(row: Row, job: Job, moment: RunMoment, begun: TimedStart | None) -> Row:
    """Adds what it was timed on; drops seconds where it, or its start, shared its cores with others."""
    others = find_largest_share((moment.timed_on, begun and begun.timed_on))
    alone = job.timed and had_alone(others)
    return replace(
        row,
        cores=moment.timed_on.cores,
        processor=moment.timed_on.processor,
        others=others,
        seconds=row.seconds if alone else dict.fromkeys(row.seconds),
    )
