"""Runs a command for each recording, some at a time; each result is whole or not there, and each failure alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.recon.batch.answer import Outcome
from splatnode.recon.batch.child import Child, Limits
from splatnode.recon.batch.keeping import hidden, hidden_log, kept, remove_leftovers
from splatnode.recon.batch.sources import Recording

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
    remove_leftovers(plan.out)
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
                yield kept(each.recording, plan.out, each.recording.name, end)
            if not over:
                time.sleep(_POLL_S)
    finally:
        for each in running:
            each.child.stop()
        remove_leftovers(plan.out)


def _started(recording: Recording, work: Work, out: Path, core: int) -> _Running:
    command = work(recording, hidden(out, recording.name))
    return _Running(recording, Child(command, hidden_log(out, recording.name), core))
