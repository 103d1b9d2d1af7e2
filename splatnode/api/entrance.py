"""The entrance of a program: it hears warnings at its own line, and errors as text that only shows."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from splatnode.capture.process.terminal import give_warnings
from splatnode.capture.process.text import sanitize_lines


@contextlib.contextmanager
def enter_api() -> Iterator[None]:
    """In here notices are Python warnings, and the texts of errors are those that the command line would print.

    What a file or a sender wrote may be part of them: a traceback in a terminal shows it and does nothing else.
    """
    with give_warnings():
        try:
            yield
        except Exception as error:
            sanitize_error(error)
            raise


def sanitize_error(error: BaseException) -> None:
    """Makes the texts of an error, and of those that led to it, printable."""
    seen: set[int] = set()
    waiting: list[BaseException | None] = [error]
    while waiting:
        each = waiting.pop()
        if each is None or id(each) in seen:
            continue
        seen.add(id(each))
        waiting += [each.__cause__, each.__context__]
        if not isinstance(each, UnicodeError) and any(isinstance(part, str) for part in each.args):
            each.args = tuple(sanitize_lines(part) if isinstance(part, str) else part for part in each.args)
