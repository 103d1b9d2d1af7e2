"""Runs a command for each recording, some at a time; each result is whole or not there, and each failure alone."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.recon.batch.answer import Outcome, outcome
from splatnode.recon.batch.child import Child, End, Limits
from splatnode.recon.batch.sources import Recording

LOG = "replay.log"  # in a result folder: what its process said; of one that failed NAME.log, beside the results
_PARTIAL, _OLD = ".partial", ".old"
_POLL_S = 0.02

Work = Callable[[Recording, Path], Sequence[str]]  # the command that writes a recording's result into this new folder


@dataclass(frozen=True)
class Plan:
    """How recordings are run."""

    out: Path  # the folder of the result folders; this process alone writes there
    cores: tuple[int, ...]  # as many recordings at a time, each on one of these
    limits: Limits


@dataclass(frozen=True, eq=False)
class _Running:
    recording: Recording
    child: Child


def run_all(todo: Iterable[Recording], work: Work, plan: Plan) -> Generator[Outcome, None, None]:
    """The outcomes as they come; a recording whose outcome is given has its result folder, if it has any.

    What is running when the iterator is closed, or when the process dies, leaves nothing but hidden files, which the
    next call removes.
    """
    _remove_leftovers(plan.out)
    waiting, running, free = iter(todo), [], list(plan.cores)
    try:
        while True:
            while free and (recording := next(waiting, None)) is not None:
                running.append(_started(recording, work, plan.out, free.pop(0)))
            if not running:
                return
            ends = [(each, each.child.ended(plan.limits)) for each in running]
            over = [(each, end) for each, end in ends if end is not None]
            running = [each for each, end in ends if end is None]
            for each, end in over:
                free.append(each.child.core)
                yield _kept(each.recording, plan.out, end)
            if not over:
                time.sleep(_POLL_S)
    finally:
        for each in running:
            each.child.stop()
        _remove_leftovers(plan.out)


def _started(recording: Recording, work: Work, out: Path, core: int) -> _Running:
    command = work(recording, _hidden(out, recording, _PARTIAL))
    return _Running(recording, Child(command, _hidden(out, recording, f".log{_PARTIAL}"), core))


def _kept(recording: Recording, out: Path, end: End) -> Outcome:
    """Gives the result its name, in place of an earlier one; of a failure what was said is kept."""
    partial, log = _hidden(out, recording, _PARTIAL), _hidden(out, recording, f".log{_PARTIAL}")
    found, final, failed_log = outcome(recording, partial, end), out / recording.name, _log_of_failed(out, recording)
    if found.failed:
        os.replace(log, failed_log)
        shutil.rmtree(partial, ignore_errors=True)
        return found
    failed_log.unlink(missing_ok=True)
    os.replace(log, partial / LOG)
    if final.exists():  # left by a driver that was killed before it could write the outcome down, or run again
        old = _hidden(out, recording, _OLD + _PARTIAL)
        os.replace(final, old)
        os.replace(partial, final)
        shutil.rmtree(old, ignore_errors=True)
    else:
        os.replace(partial, final)
    return found


def _log_of_failed(out: Path, recording: Recording) -> Path:
    return out / f"{recording.name}.log"


def _hidden(out: Path, recording: Recording, ending: str) -> Path:
    return out / f".{recording.name}{ending}"


def _remove_leftovers(out: Path) -> None:
    with os.scandir(out) as entries:
        leftovers = [Path(entry.path) for entry in entries if entry.name[0] == "." and entry.name.endswith(_PARTIAL)]
    for path in leftovers:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
