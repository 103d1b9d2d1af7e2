"""How many threads a piece of work takes, and where its seconds go.

The threads are the core's and torch's, of the thread that does the work and of its helpers. OpenCV's own threads are
the process's and are left as they are: they change no result, and little of the work is OpenCV's.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TypeVar

import torch

from splatnode.capture.process.terminal import ProgressStep, Tell, ignore_progress
from splatnode.recon import core
from splatnode.recon.core import current_thread_limit, limit_threads, num_usable_threads

# How many threads a piece of work takes: the core's and torch's, of the thread that does it and of its helpers.
#
# OpenCV's own threads are the process's and are left as they are: they change no result, and little of the work is
# OpenCV's.


@contextmanager
def apply_thread_limit(threads: int | None) -> Iterator[None]:
    """Inside the block this thread's work takes at most so many threads; None: as many as before.

    The work of other threads goes on as it did. Raises ValueError below 1.
    """
    with core.apply_thread_limit(threads):
        before = torch.get_num_threads()  # to be asked first: the first question in a thread sets it anew
        if threads is not None:
            torch.set_num_threads(core.num_usable_threads())
        try:
            yield
        finally:
            torch.set_num_threads(before)


# Independent pieces of work, one for each processor that the caller may use at a time.
#
# Threads pay where NumPy, OpenCV, SciPy, PoseLib or the core do the work, which let others run meanwhile. The
# functions must not change what others read.

Item = TypeVar("Item")
T = TypeVar("T")


def map_parallel(function: Callable[..., T], *arguments: Iterable) -> list[T]:
    """Returns `function` of each of the arguments, taken together as by `map`, in order."""
    return list(map_parallel_lazily(lambda together: function(*together), zip(*arguments, strict=False)))


def map_parallel_lazily(function: Callable[[Item], T], items: Iterable[Item]) -> Iterator[T]:
    """`function` of each of the items, in their order, as soon as it is known.

    Whoever stops asking gives up the few items that are under way, and no more are begun. What `function` raises is
    raised in the place of its result.
    """
    threads = num_usable_threads()
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads, initializer=limit_threads, initargs=(current_thread_limit(),)) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > threads:  # one more than are worked on, so that nobody waits for the next
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


# Where the seconds of a reconstruction go.


@dataclass
class Clock:
    """Seconds by stage; "wait" is for the next frame, and for whoever reads the snapshots."""

    started: float = field(default_factory=time.monotonic)
    last: float = field(default_factory=time.monotonic)
    seconds: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str) -> None:
        """Books the time since the last lap on `stage`."""
        now = time.monotonic()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now

    def deadline(self, budget_s: float | None) -> float | None:
        """When, by `time.monotonic()`, so many seconds since the start are over; None: never."""
        return None if budget_s is None else self.started + budget_s

    def resume(self) -> None:
        """Goes on as if no time had passed since the last lap: the work lay by."""
        self.leave_out(time.monotonic() - self.last)

    def leave_out(self, seconds: float) -> None:
        """Goes on as if these seconds since the last lap had not passed: other work was done."""
        self.started, self.last = self.started + seconds, self.last + seconds

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Seconds by stage, and from the start on as "total"."""
        return {**self.seconds, "total": time.monotonic() - self.started}


# What the caller of long work wants of it.


class OutOfTime(Exception):
    """The exception that ends work at its deadline: it ends with what it has."""


def _go_on() -> None:
    """Neither cancels the work nor does anything else meanwhile."""


@dataclass(frozen=True)
class RunContext:
    """How a caller goes along with long work: it can cancel it, bound its time, and hear of its progress."""

    # Called between parts of the work, about once a second: it may do other work, or raise, which cancels this one
    pause: Callable[[], None] = _go_on
    deadline: float = math.inf  # by `time.monotonic()`: what is not needed does not begin after it
    tell: Tell = ignore_progress  # hears of each step

    @property
    def is_over(self) -> bool:
        """Whether the deadline has passed; no clock is read where there is none."""
        return self.deadline < math.inf and time.monotonic() >= self.deadline

    def advance_deadline(self, deadline: float) -> RunContext:
        """Returns the same with `deadline` where that comes before its own."""
        return replace(self, deadline=min(self.deadline, deadline))

    def report(self, what: str) -> RunContext:
        """Returns the same, whose pauses tell also that `what` is being done."""

        def tell_and_pause() -> None:
            self.tell(ProgressStep(what))
            self.pause()

        return replace(self, pause=tell_and_pause)

    def end_at_deadline(self) -> RunContext:
        """Returns the same, whose pauses raise OutOfTime once the deadline has passed."""

        def pause_or_end() -> None:
            self.pause()
            if self.is_over:
                raise OutOfTime

        return replace(self, pause=pause_or_end)


BACKGROUND = RunContext()  # of work that nobody cancels, bounds or watches


class Timer:
    """Counts the seconds that work takes without its pauses, and ends it by OutOfTime after `most_s` of them."""

    def __init__(self, most_s: float, run: RunContext = BACKGROUND) -> None:
        self._most_s, self._run = most_s, run
        self._began_s, self._paused_s = time.monotonic(), 0.0

    @property
    def spent_s(self) -> float:
        return time.monotonic() - self._began_s - self._paused_s

    @property
    def run(self) -> RunContext:
        """The context of the work, whose pauses are not counted."""
        return replace(self._run, pause=self._pause)

    def _pause(self) -> None:
        """Pauses, then raises OutOfTime where the time is spent; the work calls it about once a second."""
        before = time.monotonic()
        try:
            self._run.pause()
        finally:
            self._paused_s += time.monotonic() - before
        if self.spent_s >= self._most_s:
            raise OutOfTime
