"""Runs a command for each recording, some at a time; each result is whole or not there, and each failure alone."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from splatnode.recon.batch.answer import Outcome
from splatnode.recon.batch.keeping import hidden, hidden_log, kept, remove_leftovers
from splatnode.recon.batch.sources import Recording
from splatnode.recon.jobs.child import Child, Limits
from splatnode.recon.jobs.engine import ends

Work = Callable[[Recording, Path], Sequence[str]]  # the command that writes a recording's result into this new folder


@dataclass(frozen=True)
class Plan:
    """How recordings are run."""

    out: Path  # the folder of the result folders; this process alone writes there
    cores: tuple[int, ...]  # as many recordings at a time, each on one of these
    limits: Limits


def run_all(todo: Iterable[Recording], work: Work, plan: Plan) -> Generator[Outcome, None, None]:
    """The outcomes as they come; a recording whose outcome is given has its result folder, if it has any.

    What is running when the iterator is closed, or when the process dies, leaves nothing but hidden files, which the
    next call removes.
    """
    remove_leftovers(plan.out)
    take, start = partial(next, iter(todo), None), partial(_started, work, plan.out)
    running = ends(take, start, [(core,) for core in plan.cores], plan.limits)
    try:
        for recording, end in running:
            yield kept(recording, plan.out, recording.name, end)
    finally:
        running.close()
        remove_leftovers(plan.out)


def _started(work: Work, out: Path, recording: Recording, cores: Sequence[int]) -> Child:
    return Child.started(work(recording, hidden(out, recording.name)), hidden_log(out, recording.name), cores)
