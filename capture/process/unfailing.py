"""What is done again and again, such as a heartbeat, and must not end the process that does it."""

from __future__ import annotations

import logging
from collections.abc import Callable

log = logging.getLogger(__name__)


class Unfailing:
    """Does a step and leaves it out where it fails, whatever it is for want of; says so once, until it works again."""

    def __init__(self, what: str) -> None:
        """`what`: the step in the words of a person, such as "the heartbeat"."""
        self._what = what
        self._said = ""

    def do(self, step: Callable[[], object]) -> bool:
        """Whether the step was done."""
        try:
            step()
        except Exception as error:
            kind = type(error).__name__
            if kind != self._said:
                self._said = kind
                log.error("%s is left out: %s: %s", self._what, kind, error)
            return False
        self._said = ""
        return True
