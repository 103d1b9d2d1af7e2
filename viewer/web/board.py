"""The newest there is to see, for any number of visitors who wait for it."""

from __future__ import annotations

import secrets
import threading
from dataclasses import dataclass
from typing import Any

from splatnode.viewer.web.content import Content


@dataclass(frozen=True, eq=False)
class BoardState:
    """One state of what is shown; `number` counts them. Versions tell what of it is new."""

    number: int
    said: dict[str, Any]
    live: bool = False  # more may come
    content: Content | None = None  # None: nothing has come yet
    gaussians: int = 0  # version
    shapes: int = 0  # version


class Board:
    """One writer replaces what is shown, whole; readers take it or wait for another."""

    def __init__(self) -> None:
        self.run = secrets.token_hex(8)  # of this server: after another start, numbers begin anew
        self._shown = BoardState(0, {})
        self._changed = threading.Condition()

    @property
    def current(self) -> BoardState:
        return self._shown

    def publish(self, said: dict[str, Any], content: Content | None, *, live: bool) -> None:
        """Shows this from now on, if it is not what is shown already."""
        before = self._shown
        if said == before.said and content is before.content:
            return
        gaussians, shapes = before.gaussians, before.shapes
        if content is not None and content is not before.content:
            known = before.content.moment.snapshot.gaussians if before.content else None
            gaussians += content.moment.snapshot.gaussians is not known
            shapes += 1
        with self._changed:
            self._shown = BoardState(before.number + 1, said, live, content, gaussians, shapes)
            self._changed.notify_all()

    def wait(self, run: str, number: int, timeout_s: float) -> BoardState:
        """Returns the current state once it differs from `number` of `run`, or after `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: (run, number) != (self.run, self._shown.number), timeout_s)
            return self._shown
