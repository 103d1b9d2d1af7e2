"""All windows of a plan, some at a time; what is on the disk already is not run again."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.process.records import record_of
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.evaluate.json_file import read_json
from splatnode.recon.evaluate.kept import Journal
from splatnode.recon.evaluate.records import describe_machine
from splatnode.recon.evaluate.stability.places import TrialScene
from splatnode.recon.evaluate.stability.windows import ours
from splatnode.recon.evaluate.stability.windows.row import (
    OURS,
    Key,
    WindowAnswer,
    WindowOutcome,
    WindowRow,
    judge_window,
)
from splatnode.recon.evaluate.stability.windows.store import Pieces
from splatnode.recon.evaluate.stability.windows.summary import summarise
from splatnode.recon.evaluate.stability.windows.turns import Job, WindowScheduler
from splatnode.recon.evaluate.stability.windows.window import COUNTS, draw_windows, select_moving_scenes
from splatnode.recon.evaluate.timing import check_same_cores
from splatnode.recon.jobs.call import Work, pack_call
from splatnode.recon.jobs.calls import Engine, Task, work_folder
from splatnode.recon.jobs.child import Limits
from splatnode.recon.result.export.staged import json_bytes, write_files
from splatnode.recon.result.folder import hold_result_folder

logger = logging.getLogger(__name__)

FILE = "windows.json"
_JOURNAL = "windows.jsonl"


@dataclass(frozen=True)
class Plan:
    methods: tuple[str, ...]
    per_kind: int = 2  # windows of each scene, count and stride, at most
    counts: tuple[int, ...] = COUNTS
    seed: int = 0  # of the draw of the windows
    told: ours.Told = "nothing"  # of the lens, to splatnode: see `ours.frames_of`
    fresh: bool = False  # measures each window's seconds from photographs on, too
    timeout_s: float = 120.0  # of one method on one window, from the start of its process on
    max_memory_mb: float | None = None  # of the same
    config: ReconstructionConfig = field(default_factory=ReconstructionConfig)


def run_windows(plan: Plan, places: Sequence[TrialScene], out: Path, command: str, engine: Engine) -> list[WindowRow]:
    """Runs what is missing in `out`/windows.json and returns all its rows. Rows without an answer are run again.

    What came to an end is on the disk at once, in a journal beside the file, which is rewritten every few seconds. A
    window that fails, or exceeds its time or memory, becomes a row with the verdict "FAILED" and the reason. Seconds
    are those of windows that had their cores alone. Raises ValueError where the file is of windows with another number
    of cores, or where splatnode was told the lens of its windows and now is not, or the other way round.
    """
    rows = {row.key: row for row in _resume_rows(out, plan, engine.cores_each)}
    jobs = _list_jobs(plan, places)
    whole = partial(_write, out / FILE, plan, rows, [job.key for job in jobs], command)
    with hold_result_folder(out), work_folder(out) as folder:
        if not (out / FILE).exists():
            whole()  # whether the windows of the journal had their lens given
        with Journal(out / _JOURNAL, whole) as kept:
            rows |= {row.key: row for row in (record_of(record, WindowRow) for record in kept.recover_records())}
            todo = [job for job in jobs if job.key not in rows or not _is_done(rows[job.key], plan)]
            for number, row in enumerate(_run_jobs(plan, todo, engine, folder), start=len(jobs) - len(todo) + 1):
                rows[row.key] = row
                kept.add(asdict(row))
                logger.info(
                    f"windows {number}/{len(jobs)}: {row.scene}, {row.count} at stride {row.stride} from {row.start}, "
                    f"{row.method}: {row.verdict}, {row.outcome.value}"
                )
            if not todo:
                whole()  # it tells of this command, too
    return _order_rows(rows, [job.key for job in jobs])


def _list_jobs(plan: Plan, places: Sequence[TrialScene]) -> list[Job]:
    """Scene after scene; in a scene splatnode's windows come first."""
    found = []
    for place in select_moving_scenes(places):
        windows = draw_windows(place, plan.per_kind, plan.seed, plan.counts)
        asked = [Job(place, window, method) for window in windows for method in plan.methods]
        found += sorted(asked, key=lambda job: job.method != OURS)
    return found


def _is_done(row: WindowRow, plan: Plan) -> bool:
    return row.outcome is not WindowOutcome.FAILED and (row.fresh_seconds is not None or not plan.fresh)


def _run_jobs(plan: Plan, todo: Sequence[Job], engine: Engine, folder: Path) -> Iterator[WindowRow]:
    """Rows as they are done."""
    turns = WindowScheduler(todo, folder / "found")

    def take() -> Task | None:
        turn = turns.take_job()
        return turn and Task(turn[0], pack_call(_make_work(plan, *turn)))

    limits = Limits(plan.max_memory_mb, plan.timeout_s)
    for job, answer in engine.answers(take, limits, folder / "calls"):
        nothing = WindowAnswer(None, message=answer.reason), {}
        said, found = nothing if answer.pickled is None else answer.value()
        turns.finish_job(job, found)
        yield judge_window(job.window, job.method, said, job.place.scene.cameras)


def _make_work(plan: Plan, job: Job, known: Pieces) -> Work:
    if job.method == OURS:
        return partial(ours.answer_window, job.place, job.window, plan.config, plan.fresh, plan.told, known)
    from splatnode.recon.evaluate.stability.windows import rivals  # needs pycolmap

    return partial(rivals.answer_window, job.place, job.window, job.method, plan.config.seed, plan.fresh, known)


class _Rows(msgspec.Struct, frozen=True):
    rows: list[WindowRow]
    machine: dict[str, Any] = {}
    told: ours.Told = "nothing"


def read_rows(path: Path) -> list[WindowRow]:
    """The rows of a windows.json; none where there is no such file. Raises EvaluationFileError for another file."""
    return _read_content(path).rows


def _resume_rows(out: Path, plan: Plan, cores_each: int) -> list[WindowRow]:
    path = out / FILE
    content = _read_content(path)
    begun = content.rows or (path.exists() and (out / _JOURNAL).exists())
    if begun and content.told != plan.told:
        raise ValueError(f"{path} holds windows with --told {content.told}: give another folder with --out DIR")
    before = content.machine.get("threads")  # which each window had, before a row said so itself
    known = [row.cores or before for row in content.rows if row.seconds is not None]
    check_same_cores([cores for cores in known if cores], cores_each, path)
    return content.rows


def _read_content(path: Path) -> _Rows:
    return read_json(path, _Rows, "the windows.json of this version") if path.exists() else _Rows([])


def _order_rows(rows: dict[Key, WindowRow], asked: Sequence[Key]) -> list[WindowRow]:
    """Those of the plan in its order, whichever came to its end first, after those of earlier plans."""
    planned = set(asked)
    return [*(rows[key] for key in rows if key not in planned), *(rows[key] for key in asked if key in rows)]


def _write(path: Path, plan: Plan, rows: dict[Key, WindowRow], asked: Sequence[Key], command: str) -> None:
    ordered = _order_rows(rows, asked)
    content = {
        "command": command,
        "machine": describe_machine(),
        "seed": plan.seed,
        "told": plan.told,
        "summary": summarise(ordered),
        "rows": [{**asdict(row), "right": row.right, "found": row.outcome.value} for row in ordered],
    }
    write_files(path.parent, {path.name: json_bytes(content)})
