"""Runs in their order, each after what it needs, which is made once for all that need it."""

from __future__ import annotations

import itertools
from collections import Counter, deque
from collections.abc import Callable, Generator, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatnode.recon.jobs.call import Answer, Work, pack_call
from splatnode.recon.jobs.calls import Engine, Task
from splatnode.recon.jobs.child import Limits


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
