"""What a verb is doing, for whoever waits for it: steps with how many of how many, and what was found."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from splatnode.capture.process.terminal import clear_progress, is_interactive, progress, refresh_progress, say

_SHOW_EVERY_S = 0.1  # at most so often in place
_TICK_S = 1.0  # between looks at the seconds of a step that is not heard of
_TELLS_S = 1.0  # from so many seconds on a step tells how long the rest will take
_MINUTES_FROM_S = 100.0  # longer times are told in minutes

Item = TypeVar("Item")


@dataclass(frozen=True)
class ProgressStep:
    """A part of the work that is under way."""

    doing: str  # "matching"
    done: int = 0  # things that were counted so far
    of: int = 0  # 0: nobody knows, or there is nothing to count
    what: str = ""  # one of the things that are counted: "photograph pair"

    def __str__(self) -> str:
        """`matching: 3 of 10 photograph pairs`."""
        if self.of:
            return f"{self.doing}: {self.done} of {_format_count(self.of, self.what)}"
        return f"{self.doing}: {_format_count(self.done, self.what)}" if self.done else self.doing

    @property
    def is_under_way(self) -> bool:
        """True if the step has begun, and is not known to be done."""
        return bool(self.doing) and not self.done == self.of > 0

    @property
    def announcement(self) -> str:
        """`matching: 10 photograph pairs`, as it begins."""
        return f"{self.doing}: {_format_count(self.of, self.what)}" if self.of else self.doing


Tell = Callable[[ProgressStep | str], None]  # a step each time that it has gone on, or a line about what was found


def ignore_progress(_: ProgressStep | str) -> None:
    """Ignores progress, where nobody waits."""


class ProgressPrinter:
    """Shows steps on a terminal in place, with how long they took and will take; elsewhere each once, as it begins."""

    def __init__(self) -> None:
        self._step, self._began_s, self._shown_s = ProgressStep(""), 0.0, 0.0

    def __call__(self, told: ProgressStep | str) -> None:
        if isinstance(told, str):
            self._end_step()
            say(told)
            return
        now_s, begins = time.monotonic(), told.doing != self._step.doing
        if begins:
            self._end_step()
            self._began_s = now_s
        self._step = told
        if not is_interactive():
            if begins:
                say(told.announcement, error=True)
            return
        if begins:
            progress("")
        if begins or told.done == told.of or now_s >= self._shown_s + _SHOW_EVERY_S:
            self._shown_s = now_s
            progress(f"{told} ({format_times(told, now_s - self._began_s)})")

    def _end_step(self) -> None:
        """Ends the step that was reported last, whether or not all of it was done."""
        if self._step.is_under_way:
            refresh_progress(f"{self._step} ({time.monotonic() - self._began_s:.0f} s)")

    def tick(self) -> None:
        """Shows the seconds that have passed since, where the step that was told last is still under way."""
        step = self._step
        if step.is_under_way:
            refresh_progress(f"{step} ({format_times(step, time.monotonic() - self._began_s)})")


@contextlib.contextmanager
def show_progress(quiet: bool = False) -> Iterator[Tell]:
    """Who tells whoever waits what is being done, each second at least; with `quiet` nobody."""
    if quiet:
        yield ignore_progress
        return
    told = ProgressPrinter()
    with _each_second(told.tick):
        yield told


@contextlib.contextmanager
def show_waiting(doing: str) -> Iterator[None]:
    """Shows on a terminal what is being done, if that takes more than a second, and for as long as it does."""
    began_s = time.monotonic()
    try:
        with _each_second(lambda: progress(f"{doing} ({time.monotonic() - began_s:.0f} s)")):
            yield
    finally:
        clear_progress()


@contextlib.contextmanager
def _each_second(show: Callable[[], None]) -> Iterator[None]:
    """Calls `show` from a second on, where standard error is a terminal."""
    ended = threading.Event()

    def repeat_show() -> None:
        while not ended.wait(_TICK_S):
            show()

    thread = threading.Thread(target=repeat_show, daemon=True)
    if is_interactive():
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if thread.is_alive():
            thread.join()


def report_items(items: Iterable[Item], tell: Tell, doing: str, of: int, what: str) -> Iterator[Item]:
    """The items, each of which is told when it is there; `of` is 0 where nobody knows how many there will be."""
    for done, item in enumerate(items, start=1):
        tell(ProgressStep(doing, done, of, what))
        yield item


def format_times(step: ProgressStep, taken_s: float) -> str:
    """`4 s, about 32 s left`: what is left takes as long for each as what is done took."""
    taken = f"{taken_s:.0f} s"
    if taken_s < _TELLS_S or not 0 < step.done < step.of:
        return taken
    left_s = taken_s / step.done * (step.of - step.done)
    left = f"{left_s:.0f} s" if left_s < _MINUTES_FROM_S else f"{left_s / 60:.0f} min"
    return f"{taken}, about {left} left"


def _format_count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
