"""What people are told of an input and no error tells: on the log, or to a program that calls as a Python warning."""

from __future__ import annotations

import contextlib
import logging
import sys
import warnings
from collections.abc import Iterator
from contextvars import ContextVar

from splatnode.capture.process.text import sanitize_lines

_GIVES_WARNINGS: ContextVar[bool] = ContextVar("splatnode_gives_warnings", default=False)
_OURS, _BETWEEN = "splatnode.", ("contextlib",)  # modules whose lines are none of the program that calls


class InputWarning(UserWarning):
    """A part of an input is left out, or is probably not what was meant."""


@contextlib.contextmanager
def give_warnings() -> Iterator[None]:
    """In here, and in no other thread, `notify` gives Python warnings, at the line of the program that called."""
    token = _GIVES_WARNINGS.set(True)
    try:
        yield
    finally:
        _GIVES_WARNINGS.reset(token)


def gives_warnings() -> bool:
    """Whether `notify` gives Python warnings in this thread."""
    return _GIVES_WARNINGS.get()


def notify(log: logging.Logger, text: str, kind: type[Warning] = InputWarning) -> None:
    """Tells `text`: a warning of the log, or under `give_warnings` a Python warning, whose text only shows."""
    if gives_warnings():
        warnings.warn(sanitize_lines(text), kind, stacklevel=_find_caller())
    else:
        log.warning("%s", text)


def _find_caller() -> int:
    """The level of the stack, as `warnings` counts it from `notify`, that is the program's."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and (_is_ours(name := frame.f_globals.get("__name__", "")) or name in _BETWEEN):
        frame, level = frame.f_back, level + 1
    return level


def _is_ours(module: str) -> bool:
    return module == _OURS[:-1] or module.startswith(_OURS)
