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
from splatnode.recon.config import Config
from splatnode.recon.evaluate.json_file import read_json
from splatnode.recon.evaluate.kept import Kept
from splatnode.recon.evaluate.records import this_machine
from splatnode.recon.evaluate.stability.places import Place
from splatnode.recon.evaluate.stability.windows import ours
from splatnode.recon.evaluate.stability.windows.row import OURS, Answer, Found, Key, Row, judged
from splatnode.recon.evaluate.stability.windows.store import Pieces
from splatnode.recon.evaluate.stability.windows.summary import summarise
from splatnode.recon.evaluate.stability.windows.turns import Job, Turns
from splatnode.recon.evaluate.stability.windows.window import COUNTS, moving, windows_of
from splatnode.recon.evaluate.timing import check_same_cores
from splatnode.recon.jobs.call import Work, packed
from splatnode.recon.jobs.calls import Engine, Task, work_folder
from splatnode.recon.jobs.child import Limits
from splatnode.recon.result.export.staged import json_bytes, write_files
from splatnode.recon.result.folder import result_folder

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
    config: Config = field(default_factory=Config)


def run_windows(plan: Plan, places: Sequence[Place], out: Path, command: str, engine: Engine) -> list[Row]:
    """Runs what is missing in `out`/windows.json and returns all its rows. Rows without an answer are run again.

    What came to an end is on the disk at once, in a journal beside the file, which is rewritten every few seconds. A
    window that fails, or exceeds its time or memory, becomes a row with the verdict "FAILED" and the reason. Seconds
    are those of windows that had their cores alone. Raises ValueError where the file is of windows with another number
    of cores, or where splatnode was told the lens of its windows and now is not, or the other way round.
    """
    rows = {row.key: row for row in _resumed(out, plan, engine.cores_each)}
    jobs = _jobs(plan, places)
    whole = partial(_write, out / FILE, plan, rows, [job.key for job in jobs], command)
    with result_folder(out), work_folder(out) as folder:
        if not (out / FILE).exists():
            whole()  # whether the windows of the journal had their lens given
        with Kept(out / _JOURNAL, whole) as kept:
            rows |= {row.key: row for row in (record_of(record, Row) for record in kept.left())}
            todo = [job for job in jobs if job.key not in rows or not _is_done(rows[job.key], plan)]
            for number, row in enumerate(_results(plan, todo, engine, folder), start=len(jobs) - len(todo) + 1):
                rows[row.key] = row
                kept.add(asdict(row))
                logger.info(
                    f"windows {number}/{len(jobs)}: {row.scene}, {row.count} at stride {row.stride} from {row.start}, "
                    f"{row.method}: {row.verdict}, {row.found.value}"
                )
            if not todo:
                whole()  # it tells of this command, too
    return _ordered(rows, [job.key for job in jobs])


def _jobs(plan: Plan, places: Sequence[Place]) -> list[Job]:
    """Scene after scene; in a scene splatnode's windows come first."""
    found = []
    for place in moving(places):
        windows = windows_of(place, plan.per_kind, plan.seed, plan.counts)
        asked = [Job(place, window, method) for window in windows for method in plan.methods]
        found += sorted(asked, key=lambda job: job.method != OURS)
    return found


def _is_done(row: Row, plan: Plan) -> bool:
    return row.found is not Found.FAILED and (row.fresh_seconds is not None or not plan.fresh)


def _results(plan: Plan, todo: Sequence[Job], engine: Engine, folder: Path) -> Iterator[Row]:
    """Rows as they are done."""
    turns = Turns(todo, folder / "found")

    def take() -> Task | None:
        turn = turns.next()
        return turn and Task(turn[0], packed(_work(plan, *turn)))

    limits = Limits(plan.max_memory_mb, plan.timeout_s)
    for job, answer in engine.answers(take, limits, folder / "calls"):
        nothing = Answer(None, message=answer.reason), {}
        said, found = nothing if answer.pickled is None else answer.value()
        turns.ended(job, found)
        yield judged(job.window, job.method, said, job.place.scene.cameras)


def _work(plan: Plan, job: Job, known: Pieces) -> Work:
    if job.method == OURS:
        return partial(ours.answered, job.place, job.window, plan.config, plan.fresh, plan.told, known)
    from splatnode.recon.evaluate.stability.windows import rivals  # needs pycolmap

    return partial(rivals.answered, job.place, job.window, job.method, plan.config.seed, plan.fresh, known)


class _Rows(msgspec.Struct, frozen=True):
    rows: list[Row]
    machine: dict[str, Any] = {}
    told: ours.Told = "nothing"


def read_rows(path: Path) -> list[Row]:
    """The rows of a windows.json; none where there is no such file. Raises EvaluationFileError for another file."""
    return _read(path).rows


def _resumed(out: Path, plan: Plan, cores_each: int) -> list[Row]:
    path = out / FILE
    content = _read(path)
    begun = content.rows or (path.exists() and (out / _JOURNAL).exists())
    if begun and content.told != plan.told:
        raise ValueError(f"{path} holds windows with --told {content.told}: give another folder with --out DIR")
    before = content.machine.get("threads")  # which each window had, before a row said so itself
    known = [row.cores or before for row in content.rows if row.seconds is not None]
    check_same_cores([cores for cores in known if cores], cores_each, path)
    return content.rows


def _read(path: Path) -> _Rows:
    return read_json(path, _Rows, "the windows.json of this version") if path.exists() else _Rows([])


def _ordered(rows: dict[Key, Row], asked: Sequence[Key]) -> list[Row]:
    """Those of the plan in its order, whichever came to its end first, after those of earlier plans."""
    planned = set(asked)
    return [*(rows[key] for key in rows if key not in planned), *(rows[key] for key in asked if key in rows)]


def _write(path: Path, plan: Plan, rows: dict[Key, Row], asked: Sequence[Key], command: str) -> None:
    ordered = _ordered(rows, asked)
    content = {
        "command": command,
        "machine": this_machine(),
        "seed": plan.seed,
        "told": plan.told,
        "summary": summarise(ordered),
        "rows": [{**asdict(row), "right": row.right, "found": row.found.value} for row in ordered],
    }
    write_files(path.parent, {path.name: json_bytes(content)})
