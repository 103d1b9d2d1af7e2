"""Where the seconds of a reconstruction go."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field


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


# A deadline that work asks about while it goes on.


class OutOfTime(Exception):
    """The exception that a `pause` raises at its deadline: the work ends with what it has."""


def make_deadline_pause(deadline: float | None, pause: Callable[[], None] = lambda: None) -> Callable[[], None]:
    """A `pause` that raises OutOfTime from `deadline` on, a time of `time.monotonic()`; None: never."""

    def ask() -> None:
        pause()
        if deadline is not None and time.monotonic() >= deadline:
            raise OutOfTime

    return ask


class Timer:
    """Counts the seconds that work takes without its pauses, and ends it by OutOfTime after `most_s` of them."""

    def __init__(self, most_s: float, pause: Callable[[], None] = lambda: None) -> None:
        self._most_s, self._pause = most_s, pause
        self._began_s, self._paused_s = time.monotonic(), 0.0

    @property
    def spent_s(self) -> float:
        return time.monotonic() - self._began_s - self._paused_s

    def pause(self) -> None:
        """Pauses, then raises OutOfTime where the time is spent; the work calls it about once a second."""
        before = time.monotonic()
        try:
            self._pause()
        finally:
            self._paused_s += time.monotonic() - before
        if self.spent_s >= self._most_s:
            raise OutOfTime


def is_over(until: float) -> bool:
    """True from `until` on, a time of `time.monotonic()`; infinity never ends, so no clock is read."""
    return until < math.inf and time.monotonic() >= until
