"""Work in a process of its own, so that its time and its memory are its own."""

from __future__ import annotations

import multiprocessing
import pickle
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path
from typing import TypeVar

from splatnode.recon.evaluate.protocol import STAGES
from splatnode.recon.result.export.staged import write_file
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import Snapshot

T = TypeVar("T")
Context = SpawnContext | ForkServerContext


@dataclass(frozen=True, eq=False)
class TimedSnapshot:
    """A snapshot that is to be scored, with the time and memory that the run had taken by then."""

    snapshot: Snapshot
    checkpoint: int | None  # None: the end of the run
    seconds: Mapping[str, float | None]
    peak_rss_mb: float | None


@dataclass(frozen=True, eq=False)
class RunOutcome:
    """The snapshots of a run, and why it failed if it did."""

    snapshots: tuple[TimedSnapshot, ...]
    error: str | None


def run_alone(
    reconstruct: Callable[[], Iterator[Snapshot]], checkpoints: Sequence[int], timeout_s: float, spent_s: float = 0.0
) -> RunOutcome:
    """The snapshots of a run at its checkpoints and at its end. `spent_s` went before it and is added to its time.

    The clock runs only while the reconstruction works, not while it is saved. Both the function and what it is bound to
    are sent to the new process, so it must be a functools.partial of a module's function.
    """
    with tempfile.TemporaryDirectory(prefix="splatnode-bench-") as folder:
        error = in_own_process(_run_and_save, (reconstruct, tuple(checkpoints), spent_s, folder), folder, timeout_s)
        snapshots = tuple(pickle.loads(path.read_bytes()) for path in sorted(Path(folder).glob("*.moment")))
    if error is None and not snapshots:
        error = "the reconstruction gave no snapshot"
    return RunOutcome(snapshots, error)


def call_alone(function: Callable[[], T], timeout_s: float, context: Context | None = None) -> T:
    """What a function returns. Raises RuntimeError with the reason where it does not.

    `context` starts the process; usually it is a fresh one.
    """
    with tempfile.TemporaryDirectory(prefix="splatnode-alone-") as folder:
        result = Path(folder, "result")
        error = in_own_process(_call_and_save, (function, result), folder, timeout_s, context)
        if error is None and not result.exists():
            error = "the process ended without an answer"
        if error is not None:
            raise RuntimeError(error)
        return pickle.loads(result.read_bytes())


def in_own_process(
    target: Callable[..., None], arguments: tuple, folder: str, timeout_s: float, context: Context | None = None
) -> str | None:
    """Why it failed, or None. What it saves in `folder` is read once it has ended: nothing else works meanwhile."""
    context = context or multiprocessing.get_context("spawn")
    process = context.Process(target=_reported, args=(target, arguments, folder))
    process.start()
    try:
        process.join(timeout_s)
        timed_out = process.is_alive()
    finally:
        if process.is_alive():
            process.kill()
            process.join()
    error_file = Path(folder, "error.txt")
    if timed_out:
        return f"stopped after {timeout_s:g} s"
    if error_file.exists():
        return error_file.read_text()
    if process.exitcode != 0:
        return f"the process ended with code {process.exitcode}; -9 mostly means that the memory was used up"
    return None


def _reported(target: Callable[..., None], arguments: tuple, folder: str) -> None:
    try:
        target(*arguments)
    except Exception:
        write_file(Path(folder, "error.txt"), traceback.format_exc().encode())


def _call_and_save(function: Callable[[], object], result: Path) -> None:
    write_file(result, pickle.dumps(function()))


def _run_and_save(
    reconstruct: Callable[[], Iterator[Snapshot]], checkpoints: Sequence[int], seconds: float, folder: str
) -> None:
    """Saves the first snapshot at or beyond each checkpoint, and the last of all."""
    waiting = sorted(checkpoints)
    saved, snapshot = 0, None
    started = time.perf_counter()
    for snapshot in reconstruct():
        seconds += time.perf_counter() - started
        while waiting and snapshot.iterations >= waiting[0]:
            checkpoint = waiting.pop(0)
            if not waiting or snapshot.iterations < waiting[0]:
                _save(folder, saved, snapshot, checkpoint, seconds)
                saved += 1
        started = time.perf_counter()
    seconds += time.perf_counter() - started
    if snapshot is not None:
        _save(folder, saved, snapshot, None, seconds)


def _save(folder: str, number: int, snapshot: Snapshot, checkpoint: int | None, total: float) -> None:
    stages: dict[str, float | None] = {stage: snapshot.seconds.get(stage) for stage in STAGES}
    moment = TimedSnapshot(snapshot, checkpoint, {**stages, "total": total}, peak_rss_mb())
    write_file(Path(folder, f"{number:04d}.moment"), pickle.dumps(moment))
