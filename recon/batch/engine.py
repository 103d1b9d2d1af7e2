"""Runs a command for each recording, some at a time; each result is whole or not there, and each failure alone."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from splatnode.recon.batch.answer import Outcome
from splatnode.recon.batch.keeping import finalize_result, partial_folder, partial_log, remove_leftovers
from splatnode.recon.batch.sources import BatchRecording
from splatnode.recon.jobs.child import Child, Limits
from splatnode.recon.jobs.engine import run_processes

Work = Callable[
    [BatchRecording, Path], Sequence[str]
]  # the command that writes a recording's result into this new folder


@dataclass(frozen=True)
class Plan:
    """How recordings are run."""

    out: Path  # the folder of the result folders; this process alone writes there
    cores: tuple[int, ...]  # as many recordings at a time, each on one of these
    limits: Limits


def run_all(todo: Iterable[BatchRecording], work: Work, plan: Plan) -> Generator[Outcome, None, None]:
    """The outcomes as they come; a recording whose outcome is given has its result folder, if it has any.

    What is running when the iterator is closed, or when the process dies, leaves nothing but hidden files, which the
    next call removes.
    """
    remove_leftovers(plan.out)
    take, start = partial(next, iter(todo), None), partial(_start_replay, work, plan.out)
    running = run_processes(take, start, [(core,) for core in plan.cores], plan.limits)
    try:
        for recording, end in running:
            yield finalize_result(recording, plan.out, recording.name, end)
    finally:
        running.close()
        remove_leftovers(plan.out)


def _start_replay(work: Work, out: Path, recording: BatchRecording, cores: Sequence[int]) -> Child:
    return Child.start(work(recording, partial_folder(out, recording.name)), partial_log(out, recording.name), cores)
