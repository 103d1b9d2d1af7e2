"""A deadline that work asks about while it goes on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable


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
