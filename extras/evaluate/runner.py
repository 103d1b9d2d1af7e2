"""The benchmark: every method on every scene, each run in a process of its own, some at a time; and the verbs."""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import os
import pickle
import shlex
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, Any

import msgspec
from torch import Tensor

from splatnode.capture.cameras import folder, synthetic
from splatnode.capture.frame import Frame
from splatnode.capture.process.config import record_of
from splatnode.capture.process.files import open_itself, temporary_folder
from splatnode.capture.process.terminal import ProgressStep, Tell, say, show_progress
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.dataset import (
    EvaluationScene,
    Split,
    check_distinct_names,
    compute_max_capture_bytes,
    load_scene,
    load_split,
    write_held_out_images,
    write_training_images,
)
from splatnode.extras.evaluate.methods import Start, find_start
from splatnode.extras.evaluate.protocol import (
    FAILED,
    INTERPOLATED_START,
    STAGES,
    PerceptualNetworks,
    Poses,
    Row,
    Run,
    Settings,
    evaluate,
    ignore_render,
    load_networks,
    psnr,
)
from splatnode.extras.evaluate.regions import Counts, Rasterize, compute_surfaces, count_visibility_by_name
from splatnode.extras.evaluate.report import (
    Bench,
    Renders,
    Timing,
    check_same_cores,
    describe_machine,
    explain_missing_seconds,
    find_largest_share,
    format_set_name,
    had_alone,
    make_bench_files,
    make_report_files,
    make_run_key,
    measure_timing,
    merge_benches,
    read_bench,
    redraw,
)
from splatnode.extras.jobs import (
    Answer,
    Engine,
    Limits,
    Task,
    Work,
    make_serial_engine,
    now,
    pack_call,
    work_folder,
)
from splatnode.extras.jobs import Moment as Since
from splatnode.extras.jobs import engine as opened
from splatnode.recon import rasterize
from splatnode.recon.config import ReconstructionConfig, apply_changes, preset
from splatnode.recon.pipeline import run as run_pipeline
from splatnode.recon.rasterize import Device, make_rasterizer
from splatnode.recon.result.export.staged import hold_result_folder, write_files
from splatnode.recon.result.report import bound_result_bytes, peak_rss_mb, print_summary, write_result_folder
from splatnode.recon.result.snapshot import Snapshot

# A file that holds all that was measured, and beside it a journal of what it does not hold yet.
#
# A campaign of thousands of runs cannot write all of them after each. So each run is a line of the journal, on the
# disk before the next begins in its place, and the whole is written now and then, and at the end.

WRITE_EVERY_S = 5.0  # the whole, at most so often,
_SHARE = 20.0  # and so seldom that writing it takes at most this part of the time: 1 / 20


class Journal:
    """Use it as a context manager: at the end, however that comes, the whole is written and the journal removed."""

    def __init__(self, journal: Path, write: Callable[[], None]) -> None:
        """`write` writes the whole, with all that was added. Raises OSError where there can be no journal."""
        self._path, self._write = journal, write
        self._file: IO[bytes] = open_itself(journal, "a+b")
        self._unwritten, self._next_s = 0, time.monotonic() + WRITE_EVERY_S

    def recover_records(self) -> list[Any]:
        """The records that a killed process has left, to be asked for before any is added.

        Half a line is dropped, and so is a record with a number that is not finite, which `write` could not write.
        """
        self._file.seek(0)
        content = self._file.read()
        end = content.rfind(b"\n") + 1
        self._file.truncate(end)
        records = list(_parse_records(content[:end].splitlines()))
        self._unwritten = len(records)
        return records

    def add(self, record: Any) -> None:
        """`record` is of JSON. Whoever calls has put it where `write` finds it. Raises ValueError for NaN, infinity."""
        self._file.write(f"{json.dumps(record, allow_nan=False)}\n".encode())
        self._file.flush()
        os.fsync(self._file.fileno())
        self._unwritten += 1
        if time.monotonic() >= self._next_s:
            self._write_all()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self._unwritten:
                self._write_all()
            self._path.unlink(missing_ok=True)
        finally:
            self._file.close()

    def _write_all(self) -> None:
        began_s = time.monotonic()
        self._write()
        self._file.truncate(0)
        self._unwritten, ended_s = 0, time.monotonic()
        self._next_s = ended_s + max(WRITE_EVERY_S, _SHARE * (ended_s - began_s))


def _parse_records(lines: Iterable[bytes]) -> Iterator[Any]:
    """The records of the lines but those with NaN or an infinity, which Python reads and JSON does not have."""
    for line in lines:
        odd: list[str] = []
        record = json.loads(line, parse_constant=odd.append)
        if not odd:
            yield record


# The moments of a run that are scored, with the time and memory that it had taken by then.


@dataclass(frozen=True, eq=False)
class RunMoment:
    snapshot: Snapshot
    checkpoint: int | None  # None: the end of the run
    seconds: Mapping[str, float | None]  # STAGES and "total"
    timed_on: Timing
    peak_rss_mb: float | None


@dataclass(frozen=True, eq=False)
class RunOutcome:
    """The moments of a run, and why it failed if it did."""

    moments: tuple[RunMoment, ...]
    error: str | None


def run_to_end(
    reconstruct: Callable[[], Iterator[Snapshot]], checkpoints: Sequence[int], spent_s: float = 0.0
) -> RunOutcome:
    """The first moment at or beyond each checkpoint, and the end. `spent_s` went before it and is added to its time.

    It is meant for a process of its own, whose memory is the run's. The clock runs only while the reconstruction works,
    not while a moment is saved; moments lie on the disk meanwhile. What the reconstruction raises is its error.
    """
    with temporary_folder("splatnode-bench-") as folder:
        error = None
        try:
            _run_and_save(reconstruct, checkpoints, spent_s, folder)
        except Exception:
            error = traceback.format_exc()
        moments = tuple(pickle.loads(path.read_bytes()) for path in sorted(folder.iterdir()))
    if error is None and not moments:
        error = "the reconstruction gave no snapshot"
    return RunOutcome(moments, error)


def _run_and_save(
    reconstruct: Callable[[], Iterator[Snapshot]], checkpoints: Sequence[int], seconds: float, folder: Path
) -> None:
    waiting = sorted(checkpoints)
    saved, snapshot = 0, None
    since, started = now(), time.perf_counter()
    for snapshot in reconstruct():
        seconds += time.perf_counter() - started
        while waiting and snapshot.iterations >= waiting[0]:
            checkpoint = waiting.pop(0)
            if not waiting or snapshot.iterations < waiting[0]:
                _save(folder, saved, snapshot, checkpoint, seconds, since)
                saved += 1
        started = time.perf_counter()
    seconds += time.perf_counter() - started
    if snapshot is not None:
        _save(folder, saved, snapshot, None, seconds, since)


def _save(folder: Path, number: int, snapshot: Snapshot, checkpoint: int | None, total: float, since: Since) -> None:
    seconds: dict[str, float | None] = {stage: snapshot.seconds.get(stage) for stage in STAGES}
    moment = RunMoment(snapshot, checkpoint, {**seconds, "total": total}, measure_timing(since), peak_rss_mb())
    (folder / f"{number:04d}").write_bytes(pickle.dumps(moment))


# One run of a benchmark, in a process of its own: the reconstruction, and what it scores.

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
    by_region: bool = False  # also of what two training photographs show, one, or none (regions.py)


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


# Runs in their order, each after what it needs, which is made once for all that need it.


@dataclass(frozen=True)
class Prerequisite:
    """The prerequisite of runs; those with the same `key` are one."""

    key: Hashable
    work: Work


@dataclass(frozen=True)
class PlannedRun:
    """A run. `work` makes its call of what its needs returned, pickled, in their order."""

    about: Any
    needs: tuple[Prerequisite, ...]
    work: Callable[..., Work]


def run_schedule(
    runs: Sequence[PlannedRun], engine: Engine, limits: Limits, folder: Path
) -> Generator[tuple[PlannedRun, Answer], None, None]:
    """The runs as they come to their end, each with its answer; where a need has none, that is its answer, too.

    `folder` is for files that are there meanwhile.
    """
    schedule = _Schedule(runs, folder / "needs")
    answers = engine.answers(schedule.take, limits, folder / "calls")
    for about, answer in answers:
        if isinstance(about, PlannedRun):
            schedule.release(about)
            yield about, answer
        else:
            for run in schedule.store_result(about, answer):
                yield run, answer


class _Schedule:
    def __init__(self, runs: Sequence[PlannedRun], folder: Path) -> None:
        self._waiting = deque(runs)
        self._folder, self._numbers = folder, itertools.count()
        self._begun: set[Hashable] = set()
        self._made: dict[Hashable, Path] = {}  # where it lies: it may be large
        self._users = Counter(need.key for run in runs for need in run.needs)

    def take(self) -> Task | None:
        """The first run that has what it needs; before that, what an earlier one needs and nobody has begun."""
        for run in self._waiting:
            if need := next((need for need in run.needs if need.key not in self._begun), None):
                self._begun.add(need.key)
                return Task(need, pack_call(need.work))
            if all(need.key in self._made for need in run.needs):
                self._waiting.remove(run)
                return Task(run, pack_call(run.work(*(self._made[need.key].read_bytes() for need in run.needs))))
        return None

    def store_result(self, need: Prerequisite, answer: Answer) -> list[PlannedRun]:
        """Keeps what was made; where nothing was, the runs that will never be."""
        if answer.pickled is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._made[need.key] = self._folder / str(next(self._numbers))
            self._made[need.key].write_bytes(answer.pickled)
            return []
        lost = [run for run in self._waiting if any(each.key == need.key for each in run.needs)]
        for run in lost:
            self._waiting.remove(run)
            self.release(run)
        return lost

    def release(self, run: PlannedRun) -> None:
        """Removes what no other run needs."""
        for need in run.needs:
            self._users[need.key] -= 1
            if not self._users[need.key] and need.key in self._made:
                self._made.pop(need.key).unlink()


logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """The runs to make. `checkpoints` are iterations at which a run is scored besides its end."""

    scenes: tuple[Path, ...]
    views: tuple[int, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)
    checkpoints: tuple[int, ...] = ()
    timeout_s: float = 3600.0  # of one run with its scores, from the start of its process on
    max_memory_mb: float | None = None  # of one run
    timed: bool = True  # False: runs share what nobody watches, such as a GPU, so that their seconds say nothing


@dataclass(frozen=True)
class MethodRunner:
    """How methods are run. Those whose `start_of` is equal share cameras and points; None: it finds its own."""

    reconstruct: Reconstruct
    start_of: Callable[[str], ReconstructionConfig | None]
    device: str = "cpu"  # on which they compute, and their scenes are scored, for the record


def run_bench(
    plan: Plan,
    entrants: MethodRunner,
    out_dir: Path,
    *,
    scoring: Scoring,
    command: str,
    resume: bool = False,
    engine: Engine | None = None,
) -> Bench:
    """Runs the plan and returns all that `out_dir` then holds; with `resume`, of runs that it holds what failed alone.

    `engine` says where runs are made and how many at a time; None: here, one at a time, on all cores. What came to an
    end is on the disk at once, in a journal beside bench.json, which is rewritten every few seconds, with bench.csv and
    the reports. Cameras and points that several methods start from are found once for each set of photographs and seed;
    their seconds count in each method's total. A run that fails, or exceeds its time or memory, becomes a row with the
    verdict "FAILED" and the reason. Seconds are those of runs that had their cores alone. Raises ValueError or
    FileNotFoundError for a scene or split that is not there or not told from another one, or for an `out_dir` that
    holds runs that were made or scored otherwise or had another number of cores, before anything is run.
    """
    engine = engine or make_serial_engine()
    sets = _load_sets(plan)
    known = read_bench(out_dir / "bench.json") if resume and (out_dir / "bench.json").exists() else None
    planned = set(_order_runs(sets, plan))
    before = _create_bench(plan, entrants, sets, scoring, command)
    if known is not None:
        _check_resumable(known, before, engine, out_dir)
        before = _merge_known_bench(known, before, planned)
    present, found = before.successful_runs(), dict[_Key, list[Row]]()
    with hold_result_folder(out_dir), work_folder(out_dir) as folder:
        write_files(out_dir, make_bench_files(before))  # how the runs of the journal are scored
        if not resume:
            (out_dir / _JOURNAL).unlink(missing_ok=True)
        with Journal(out_dir / _JOURNAL, lambda: _write(out_dir, _add_rows(before, found, sets, plan))) as kept:
            for rows in (record_of(record, list[Row]) for record in kept.recover_records()):
                key, failed = make_run_key(rows[-1]), rows[-1].verdict == FAILED
                if key not in present and not (failed and key in planned):
                    found[key] = rows
            todo = _plan_missing_runs(plan, entrants, sets, scoring, present | found.keys())
            runs = run_schedule(todo, engine, Limits(plan.max_memory_mb, plan.timeout_s), folder)
            for rows in _log_progress(_write_and_collect_rows(runs, out_dir), len(todo)):
                found[make_run_key(rows[-1])] = rows
                kept.add([asdict(row) for row in rows])
    return _add_rows(before, found, sets, plan)


_Key = tuple[str, int, str, int]  # as report.make_run_key makes it
_Set = tuple[EvaluationScene, Split]
_JOURNAL = "bench.jsonl"


def _load_sets(plan: Plan) -> list[_Set]:
    """Scenes with absolute paths: other machines see them, too, not this process's folder.

    Raises ValueError where two scenes have one name, or two splits of a scene as many training views.
    """
    check_distinct_names(plan.scenes)
    folders = [Path(os.path.abspath(folder)) for folder in plan.scenes]
    scenes = [(load_scene(folder), folder) for folder in folders]
    sets = [
        (scene, load_split(folder, list(scene.cameras), views))
        for (scene, folder), views in itertools.product(scenes, plan.views)
    ]
    for (name, count), splits in Counter((scene.name, len(split.train)) for scene, split in sets).items():
        if splits > 1:
            raise ValueError(
                f"{name} has {splits} splits with {count} training views, of the numbers of views "
                f"{', '.join(map(str, plan.views))}: runs are told apart by them, so give numbers that differ"
            )
    return sets


def _create_bench(plan: Plan, entrants: MethodRunner, sets: Sequence[_Set], scoring: Scoring, command: str) -> Bench:
    """The plan, of which nothing has run."""
    splits = {format_set_name(scene.name, len(split.train)): split for scene, split in sets}
    checkpoints = tuple(sorted(set(plan.checkpoints)))
    made = scoring.by_region, checkpoints, entrants.device, splits
    return Bench((), scoring.settings, describe_machine(), command, *made)


def _check_resumable(known: Bench, now: Bench, engine: Engine, out_dir: Path) -> None:
    if known.settings != now.settings:
        raise ValueError(f"{out_dir} holds views that were scored with {known.settings}: resume into another folder")
    for name in ("by_region", "checkpoints", "device"):
        before, wanted = getattr(known, name), getattr(now, name)
        if before is not None and before != wanted:
            raise ValueError(f"{out_dir} holds runs with {name} {before}, now {wanted}: resume into another folder")
    for name, split in now.splits.items():
        if known.splits.get(name, split) != split:
            raise ValueError(f"{out_dir} holds runs of {name}, with another split: resume into another folder")
    before = known.machine.get("threads")  # which each run had, before a row said so itself
    cores = [row.cores or before for row in known.rows if row.seconds.get("total") is not None]
    check_same_cores([each for each in cores if each], engine.cores_each, out_dir)


def _merge_known_bench(known: Bench, now: Bench, planned: set[_Key]) -> Bench:
    """Returns `known` with what the plan adds, but without its failed runs: they are run again."""
    again = (known.final_runs() - known.successful_runs()) & planned
    return msgspec.structs.replace(
        known,
        rows=tuple(row for row in known.rows if make_run_key(row) not in again),
        machine=now.machine,
        command=known.command if now.command in known.command else f"{known.command}; {now.command}",
        splits=known.splits | now.splits,
    )


def _plan_missing_runs(
    plan: Plan, entrants: MethodRunner, sets: Sequence[_Set], scoring: Scoring, finished: set[_Key]
) -> list[PlannedRun]:
    """The runs that are missing, in their order, with what they need."""
    todo = []
    for (scene, split), seed, method in itertools.product(sets, plan.seeds, plan.methods):
        if (scene.name, len(split.train), method, seed) in finished:
            continue
        reconstruct, timed = entrants.reconstruct, plan.timed
        job = Job(scene, split, method, seed, plan.checkpoints, reconstruct, scoring, timed)
        start = _require_start(entrants.start_of(method), scene, split, seed)
        shown = _require_visibility(scene, sets, scoring) if scoring.by_region else None
        work = partial(_make_work, job, start is not None)
        todo.append(PlannedRun(job, tuple(need for need in (start, shown) if need is not None), work))
    return todo


def _make_work(job: Job, with_start: bool, *needed: bytes) -> Work:
    """The call of a run; first of what it needs comes the start, where it has one."""
    start, *rest = needed if with_start else (None, *needed)
    return partial(run_and_score, job, start, rest[0] if rest else None)


def _require_start(
    config: ReconstructionConfig | None, scene: EvaluationScene, split: Split, seed: int
) -> Prerequisite | None:
    if config is None:
        return None
    key = scene.name, len(split.train), seed, repr(config)
    return Prerequisite(key, partial(time_start, scene, split, msgspec.structs.replace(config, seed=seed)))


def _require_visibility(scene: EvaluationScene, sets: Sequence[_Set], scoring: Scoring) -> Prerequisite:
    splits = [split for other, split in sets if other.name == scene.name]
    return Prerequisite(scene.name, partial(compute_visibility_by_split, scene, splits, scoring.settings.longer_side))


def _write_and_collect_rows(runs: Iterable[tuple[PlannedRun, Answer]], out_dir: Path) -> Iterator[list[Row]]:
    """The rows of each run, as they come; its renders are written."""
    for run, answer in runs:
        made = _unpack_result(run.about, answer)
        if made.renders:
            write_files(out_dir, made.renders)
        yield made.rows


def _unpack_result(job: Job, answer: Answer) -> RunResult:
    return RunResult([make_failed_row(job, answer.reason)], {}) if answer.pickled is None else answer.value()


def _log_progress(runs: Iterator[list[Row]], total: int) -> Iterator[list[Row]]:
    started = time.monotonic()
    for number, rows in enumerate(runs, start=1):
        yield rows
        left = (time.monotonic() - started) / number * (total - number)
        logger.info("bench %d/%d, about %.0f min left: %s", number, total, left / 60, format_run(rows[-1]))


def _order_runs(sets: Sequence[_Set], plan: Plan) -> list[_Key]:
    return [
        (scene.name, len(split.train), method, seed)
        for (scene, split), seed, method in itertools.product(sets, plan.seeds, plan.methods)
    ]


def _add_rows(before: Bench, found: dict[_Key, list[Row]], sets: Sequence[_Set], plan: Plan) -> Bench:
    """Adds the rows that were found since, in the order of the plan, whichever run ended first."""
    order = _order_runs(sets, plan)
    planned = set(order)
    listed = [*(key for key in found if key not in planned), *(key for key in order if key in found)]
    return msgspec.structs.replace(before, rows=(*before.rows, *(row for key in listed for row in found[key])))


def _write(out_dir: Path, bench: Bench) -> None:
    write_files(out_dir, make_bench_files(bench) | make_report_files(bench, out_dir))


def format_run(row: Row) -> str:
    """Formats what a run scored and took, in one line of text."""
    scene, views, method, seed = make_run_key(row)
    score = "not scored" if row.psnr is None else f"{row.psnr:.2f} dB, {row.ssim:.3f} SSIM"
    seconds = row.seconds.get("total")
    took = "" if seconds is None else f", {seconds:.1f} s"
    if not had_alone(row.others):
        took = f", seconds not reported: others took {row.others:.0%} of its cores"
    return f"{scene} {views} views, {method}, seed {seed}: {row.verdict}, {score}{took}"


# The verbs that measure: what runs them.

EXIT_GOOD, EXIT_REFUSED = 0, 65
# Of the search for a held-out view's pose, half of them at half the resolution: 33.0 dB in the mean, as 100 at full.
DEMO_STEPS = 80


def demo(args: argparse.Namespace) -> int:
    """Writes the built-in capture, reconstructs it, and then measures the result on views that it has not seen."""
    with show_progress(quiet=args.json) as tell:
        return _demo(args, tell)


def _demo(args: argparse.Namespace, tell: Tell) -> int:
    seed = args.seed or 0
    config = apply_changes(preset("balanced"), {"seed": seed, "device": args.device or "cpu"})
    place = synthetic.Config(seed=seed)
    needed_bytes = bound_result_bytes([(place.width, place.height)] * place.views, config.size, None)
    with hold_result_folder(args.out, needed_bytes + compute_max_capture_bytes(place)):
        capture = args.out / "capture"
        tell(f"photographing the built-in place, {place.views} times")
        split = write_training_images(capture, place)
        photographs = folder.stream(folder.Config(folder=capture / "images", names=split.train))
        snapshot = run_pipeline(photographs, config, tell=tell)
        write = partial(write_result_folder, snapshot, args.out, seed=seed, preset_name="balanced")
        tell(ProgressStep("writing the results"))
        report = write()
        if not args.json:
            print_summary(snapshot, args.out)
        if snapshot.verdict.publishable:
            tell(f"measuring it on {len(split.test)} views that it has not seen")
            write_held_out_images(capture, place)
            report = write(
                extra_fields={"held_out": evaluate_held_out_views(snapshot, capture, split, config.device, tell)}
            )
        if args.json:
            print(json.dumps(report))
    return EXIT_GOOD if snapshot.verdict.publishable else EXIT_REFUSED


def evaluate_held_out_views(
    snapshot: Snapshot, capture: Path, split: Split, on: Device = "cpu", tell: Callable[[str], None] = say
) -> dict[str, float | None]:
    """Mean scores over the test views, each of which is told, and the errors of the estimated cameras."""

    def report_view(name: str, truth: Tensor, image: Tensor) -> None:
        tell(f"{name}: {psnr(image, truth):.1f} dB")

    row = evaluate(
        snapshot,
        load_scene(capture),
        split,
        Run("balanced", 0, None, snapshot.seconds, None),
        rasterize=make_rasterizer(rasterize.choose_device(on)),
        networks=PerceptualNetworks(alex=None, vgg=None),
        settings=Settings(alignment_steps=DEMO_STEPS, alignment_levels=2),
        show=report_view,
    )
    tell(f"held-out views: {row.psnr:.1f} dB PSNR, {row.ssim:.3f} SSIM")
    wanted = ("psnr", "ssim", "rotation_error_deg", "centre_error_pct", "focal_error_pct")
    return {name: getattr(row, name) for name in wanted}


def bench(args: argparse.Namespace) -> int:
    """Measures methods on scenes with true cameras, or draws again what was measured."""
    if bool(args.scenes) == bool(args.redraw):
        raise ValueError("bench must get scenes to measure, or --redraw with what was measured")
    if args.redraw:
        found = merge_benches([read_bench(path) for path in args.redraw])
    else:
        found = _run_bench(args)
        for row in found.rows:
            if row.final:
                say(format_run(row))
        if why := explain_missing_seconds([row.others for row in found.rows if row.final]):
            say(why)
    redraw(found, args.out)
    say(f"results: {args.out}/ (report.html, report.md, bench.json, bench.csv)")
    return EXIT_GOOD


def _run_bench(args: argparse.Namespace) -> Bench:
    wanted = args.device or "cpu"
    on = rasterize.choose_device(wanted)
    one_gpu = on.type != "cpu" and (args.ray is not None or (args.cores or 1) > 1)
    plan = Plan(
        tuple(args.scenes),
        args.views,
        methods.expand_method_names(args.methods),
        tuple(range(args.seeds)),
        args.checkpoints,
        args.timeout_s,
        args.max_memory,
        timed=not one_gpu,
    )
    scoring = Scoring(
        make_rasterizer(on),
        partial(load_networks, args.weights_dir and args.weights_dir.absolute()),
        replace(INTERPOLATED_START if args.interpolate_start else Settings(), best_gain=args.color_correct),
        args.score_regions,
    )
    with opened(args.cores, args.ray) as engine:
        return run_bench(
            plan,
            MethodRunner(partial(methods.run_method, device=wanted), methods.select_start_config, on.type),
            args.out,
            scoring=scoring,
            command=shlex.join(["splatnode", *sys.argv[1:]]),
            resume=args.resume,
            engine=engine,
        )
