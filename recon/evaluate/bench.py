"""The benchmark: every method on every scene, each run in a process of its own, some at a time."""

from __future__ import annotations

import itertools
import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import msgspec

from splatnode.capture.process.records import record_of
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.evaluate.kept import Journal
from splatnode.recon.evaluate.one_run import (
    Job,
    Reconstruct,
    RunResult,
    Scoring,
    compute_visibility_by_split,
    make_failed_row,
    run_and_score,
    time_start,
)
from splatnode.recon.evaluate.protocol import FAILED, Row
from splatnode.recon.evaluate.records import (
    Bench,
    describe_machine,
    format_set_name,
    make_bench_files,
    make_run_key,
    read_bench,
)
from splatnode.recon.evaluate.report import make_report_files
from splatnode.recon.evaluate.schedule import PlannedRun, Prerequisite, run_schedule
from splatnode.recon.evaluate.splits import Split, load_split
from splatnode.recon.evaluate.timing import check_same_cores, had_alone
from splatnode.recon.evaluate.truth import EvaluationScene, check_distinct_names, load_scene
from splatnode.recon.jobs.call import Answer, Work
from splatnode.recon.jobs.calls import Engine, make_serial_engine, work_folder
from splatnode.recon.jobs.child import Limits
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.folder import hold_result_folder

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


_Key = tuple[str, int, str, int]  # of records.run_of
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
