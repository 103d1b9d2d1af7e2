"""One run of a benchmark, in a process of its own: the reconstruction, and what it scores."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

from splatnode.capture.frame import Frame
from splatnode.recon.config import Config
from splatnode.recon.evaluate.appearance import Rasterize
from splatnode.recon.evaluate.moments import Moment, run_to_its_end
from splatnode.recon.evaluate.perceptual import Networks
from splatnode.recon.evaluate.protocol import FAILED, STAGES, Poses, Row, Run, Settings, evaluate, ignore_render
from splatnode.recon.evaluate.regions import Counts
from splatnode.recon.evaluate.renders import Renders
from splatnode.recon.evaluate.shown import counts_of, surfaces
from splatnode.recon.evaluate.splits import Split
from splatnode.recon.evaluate.start import Start, find_start
from splatnode.recon.evaluate.timing import Timing, had_alone, most_taken, timing
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
    networks: Callable[[], Networks]  # loads them: a module's function, or a functools.partial of one
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
class Done:
    """What a run leaves: its checkpoints and its end, or its failure, and renders by `renders.Renders`."""

    rows: list[Row]
    renders: Mapping[str, bytes]


@dataclass(frozen=True, eq=False)
class TimedStart:
    start: Start
    timed_on: Timing


def timed_start(scene: EvaluationScene, split: Split, config: Config) -> TimedStart:
    """Cameras and points that several methods start from."""
    frames, since = scene.frames(split.train), now()
    start = find_start(frames, config)
    return TimedStart(start, timing(since))


def seen(scene: EvaluationScene, splits: Sequence[Split], longer_side: int) -> Seen:
    """What the training photographs of each split show of its test views, by the true cameras."""
    found = surfaces(scene, longer_side)
    counts = {}
    for split in splits:
        training = [found[name] for name in split.train if name in found]
        counts[len(split.train)] = counts_of(split.test, found, training)
    return counts


def done(job: Job, start: bytes | None, shown: bytes | None) -> Done:
    """Runs `job`, from the pickled `timed_start`, if there is one, and scores it; `shown` is the pickled `seen`."""
    begun: TimedStart | None = pickle.loads(start) if start else None
    counts: Mapping[str, Counts] = pickle.loads(shown)[len(job.split.train)] if shown else {}
    frames = job.scene.frames(job.split.train)
    work = partial(job.reconstruct, frames, job.method, job.seed, begun and begun.start)
    outcome = run_to_its_end(work, job.checkpoints, begun.start.seconds if begun else 0.0)
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
            _run(job, moment, begun),
            rasterize=job.scoring.rasterize,
            networks=networks if at_the_end else networks.quickest,
            settings=job.scoring.settings,
            show=renders.keep if at_the_end else ignore_render,
            found=poses,
            shown=counts,
        )
        rows.insert(0, _timed(row, job, moment, begun))
    rows = rows if outcome.error is None else [*rows, failed_row(job, outcome.error)]
    return Done(_finite(rows, job), renders.files)


def _finite(rows: Sequence[Row], job: Job) -> list[Row]:
    """The rows; up to the first one with a number that is not finite, as of a run that broke off there, if there is."""
    for index, row in enumerate(rows):
        if measure := _not_finite(row):
            when = "the end" if row.checkpoint is None else f"iteration {row.iterations}"
            return [*rows[:index], failed_row(job, f"{measure} is not finite at {when}")]
    return list(rows)


def _not_finite(row: Row) -> str:
    """The first of the row's measures that no JSON file can hold; empty where there is none."""
    for name, value in asdict(row).items():
        try:
            json.dumps(value, allow_nan=False)
        except ValueError:
            return name
    return ""


def failed_row(job: Job, error: str) -> Row:
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


def _run(job: Job, moment: Moment, begun: TimedStart | None) -> Run:
    peaks = [peak for peak in (moment.peak_rss_mb, begun and begun.start.peak_rss_mb) if peak is not None]
    return Run(job.method, job.seed, moment.checkpoint, moment.seconds, max(peaks, default=None))


def _timed(row: Row, job: Job, moment: Moment, begun: TimedStart | None) -> Row:
    """With what it was timed on; without seconds where it, or its start, did not have its cores alone."""
    others = most_taken((moment.timed_on, begun and begun.timed_on))
    alone = job.timed and had_alone(others)
    return replace(
        row,
        cores=moment.timed_on.cores,
        processor=moment.timed_on.processor,
        others=others,
        seconds=row.seconds if alone else dict.fromkeys(row.seconds),
    )
