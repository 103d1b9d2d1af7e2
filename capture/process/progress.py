"""What a verb is doing, for whoever waits for it: steps with how many of how many, and what was found."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from splatnode.capture.process.terminal import again, in_place, progress, say, taken_away

_SHOW_EVERY_S = 0.1  # at most so often in place
_TICK_S = 1.0  # between looks at the seconds of a step that is not heard of
_TELLS_S = 1.0  # from so many seconds on a step tells how long the rest will take
_MINUTES_FROM_S = 100.0  # longer times are told in minutes

Item = TypeVar("Item")


@dataclass(frozen=True)
class Step:
    """A part of the work that is under way."""

    doing: str  # "matching"
    done: int = 0  # things that were counted so far
    of: int = 0  # 0: nobody knows, or there is nothing to count
    what: str = ""  # one of the things that are counted: "photograph pair"

    def __str__(self) -> str:
        """`matching: 3 of 10 photograph pairs`."""
        if self.of:
            return f"{self.doing}: {self.done} of {_counted(self.of, self.what)}"
        return f"{self.doing}: {_counted(self.done, self.what)}" if self.done else self.doing

    @property
    def is_under_way(self) -> bool:
        """Whether it has begun, and is not known to be done."""
        return bool(self.doing) and not self.done == self.of > 0

    @property
    def announced(self) -> str:
        """`matching: 10 photograph pairs`, as it begins."""
        return f"{self.doing}: {_counted(self.of, self.what)}" if self.of else self.doing


Tell = Callable[[Step | str], None]  # a step each time that it has gone on, or a line about what was found


def told_to_nobody(_: Step | str) -> None:
    """Where nobody waits."""


class Told:
    """Shows steps on a terminal in place, with how long they took and will take; elsewhere each once, as it begins."""

    def __init__(self) -> None:
        self._step, self._began_s, self._shown_s = Step(""), 0.0, 0.0

    def __call__(self, told: Step | str) -> None:
        if isinstance(told, str):
            self._without_what_is_left()
            say(told)
            return
        now_s, begins = time.monotonic(), told.doing != self._step.doing
        if begins:
            self._without_what_is_left()
            self._began_s = now_s
        self._step = told
        if not in_place():
            if begins:
                say(told.announced, error=True)
            return
        if begins:
            progress("")
        if begins or told.done == told.of or now_s >= self._shown_s + _SHOW_EVERY_S:
            self._shown_s = now_s
            progress(f"{told} ({times(told, now_s - self._began_s)})")

    def _without_what_is_left(self) -> None:
        """What comes next ends the step that was told last, whether or not all was done."""
        if self._step.is_under_way:
            again(f"{self._step} ({time.monotonic() - self._began_s:.0f} s)")

    def tick(self) -> None:
        """Shows the seconds that have passed since, where the step that was told last is still under way."""
        step = self._step
        if step.is_under_way:
            again(f"{step} ({times(step, time.monotonic() - self._began_s)})")


@contextlib.contextmanager
def telling(quiet: bool = False) -> Iterator[Tell]:
    """Who tells whoever waits what is being done, each second at least; with `quiet` nobody."""
    if quiet:
        yield told_to_nobody
        return
    told = Told()
    with _each_second(told.tick):
        yield told


@contextlib.contextmanager
def waiting(doing: str) -> Iterator[None]:
    """Shows on a terminal what is being done, if that takes more than a second, and for as long as it does."""
    began_s = time.monotonic()
    try:
        with _each_second(lambda: progress(f"{doing} ({time.monotonic() - began_s:.0f} s)")):
            yield
    finally:
        taken_away()


@contextlib.contextmanager
def _each_second(show: Callable[[], None]) -> Iterator[None]:
    """Calls `show` from a second on, where standard error is a terminal."""
    ended = threading.Event()

    def go_on() -> None:
        while not ended.wait(_TICK_S):
            show()

    thread = threading.Thread(target=go_on, daemon=True)
    if in_place():
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if thread.is_alive():
            thread.join()


def counted(items: Iterable[Item], tell: Tell, doing: str, of: int, what: str) -> Iterator[Item]:
    """The items, each of which is told when it is there; `of` is 0 where nobody knows how many there will be."""
    for done, item in enumerate(items, start=1):
        tell(Step(doing, done, of, what))
        yield item


def times(step: Step, taken_s: float) -> str:
    """`4 s, about 32 s left`: what is left takes as long for each as what is done took."""
    taken = f"{taken_s:.0f} s"
    if taken_s < _TELLS_S or not 0 < step.done < step.of:
        return taken
    left_s = taken_s / step.done * (step.of - step.done)
    left = f"{left_s:.0f} s" if left_s < _MINUTES_FROM_S else f"{left_s / 60:.0f} min"
    return f"{taken}, about {left} left"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
