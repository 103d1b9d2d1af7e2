"""A deadline that work asks about while it goes on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable


class OutOfTime(Exception):
    """What a `pause` raises when its deadline is over: the work ends with what it has, if that is enough."""


def pausing_until(deadline: float | None, pause: Callable[[], None] = lambda: None) -> Callable[[], None]:
    """A `pause` that raises OutOfTime from `deadline` on, a time of `time.monotonic()`; None: never."""

    def ask() -> None:
        pause()
        if deadline is not None and time.monotonic() >= deadline:
            raise OutOfTime

    return ask


def is_over(until: float) -> bool:
    """Whether it is `until` or later, a time of `time.monotonic()`; of infinity, which is never, no clock is asked."""
    return until < math.inf and time.monotonic() >= until
