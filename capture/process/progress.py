"""What a verb is doing, for whoever waits for it: steps with how many of how many, and what was found."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from splatnode.capture.process.terminal import in_place, progress, say

_SHOW_EVERY_S = 0.1  # at most so often in place

Item = TypeVar("Item")


@dataclass(frozen=True)
class Step:
    """A part of the work that is under way."""

    doing: str  # "matching"
    done: int = 0
    of: int = 0  # 0: nobody knows, or there is nothing to count
    what: str = ""  # one of the things that are counted: "photograph pair"

    def __str__(self) -> str:
        """`matching: 3 of 10 photograph pairs`."""
        if self.of:
            return f"{self.doing}: {self.done} of {_counted(self.of, self.what)}"
        return f"{self.doing}: {_counted(self.done, self.what)}" if self.done else self.doing

    @property
    def announced(self) -> str:
        """`matching: 10 photograph pairs`, as it begins."""
        return f"{self.doing}: {_counted(self.of, self.what)}" if self.of else self.doing


Tell = Callable[[Step | str], None]  # a step each time that it has gone on, or a line about what was found


def told_to_nobody(_: Step | str) -> None:
    """Where nobody waits."""


class Told:
    """Shows steps on a terminal in place, with their seconds; elsewhere each once, as a line when it begins."""

    def __init__(self) -> None:
        self._doing, self._began_s, self._shown_s = "", 0.0, 0.0

    def __call__(self, told: Step | str) -> None:
        if isinstance(told, str):
            say(told)
            return
        now_s, begins = time.monotonic(), told.doing != self._doing
        if begins:
            self._doing, self._began_s = told.doing, now_s
        if not in_place():
            if begins:
                say(told.announced, error=True)
            return
        if begins:
            progress("")
        if begins or told.done == told.of or now_s >= self._shown_s + _SHOW_EVERY_S:
            self._shown_s = now_s
            progress(f"{told} ({now_s - self._began_s:.0f} s)")


def counted(items: Iterable[Item], tell: Tell, doing: str, of: int, what: str) -> Iterator[Item]:
    """The items, each of which is told when it is there; `of` is 0 where nobody knows how many there will be."""
    for done, item in enumerate(items, start=1):
        tell(Step(doing, done, of, what))
        yield item


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
