"""The moments of a run that are scored, with the time and memory that it had taken by then."""

from __future__ import annotations

import pickle
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture.process.private import temporary_folder
from splatnode.recon.evaluate.protocol import STAGES
from splatnode.recon.evaluate.timing import Timing, measure_timing
from splatnode.recon.jobs.alone import Moment as Since
from splatnode.recon.jobs.alone import now
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import Snapshot


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
