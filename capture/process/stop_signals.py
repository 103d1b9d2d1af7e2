"""The first signal stops a process cleanly, the second ends it at once: what it writes is whole or not there."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable

_REPEATED_S = 0.5  # a signal that comes again sooner is the same one: timeout(1) sends each twice


def handle_first_signal(numbers: tuple[signal.Signals, ...], stop: Callable[[], object]) -> None:
    """Calls `stop` at the first of these signals; the second does what it does to any process."""
    first_s = math.inf

    def handle(number: int, _frame: object) -> None:
        nonlocal first_s
        if first_s == math.inf:
            first_s = time.monotonic()
            stop()
        elif time.monotonic() - first_s > _REPEATED_S:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    for number in numbers:
        signal.signal(number, handle)
