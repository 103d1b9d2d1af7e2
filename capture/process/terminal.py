"""What a verb prints reaches the terminal as text that only shows: the one place through which all of it goes.

Every character but a line break is printable, so that no name or message moves the cursor, sets a title or turns the
writing direction. A line that begins with "<0>", which the journal takes for a priority, is set in by a space.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
import threading
from collections.abc import Iterator
from typing import Any

from splatnode.capture.process.printable import escaped

_PRIORITY = re.compile(r"^(?=<[0-9]*>)", re.MULTILINE)


@contextlib.contextmanager
def shown_as_text() -> Iterator[None]:
    """Standard output and error take only text in here; the streams that were there before are there again after."""
    before = sys.stdout, sys.stderr
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that a terminal cannot show costs no result
    sys.stdout, sys.stderr = (stream and _Shown(stream) for stream in before)  # None where it is closed
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def beneath(stream: Any) -> Any:
    """The stream itself, for lines that are safe by the way in which they are made."""
    return stream.beneath if isinstance(stream, _Shown) else stream


def say(line: object, *, error: bool = False) -> None:
    """Prints `line` on standard output or error; a line break in it, which a name may have, is shown as an escape."""
    print(escaped(str(line)), file=sys.stderr if error else sys.stdout, flush=True)


def progress(text: str) -> None:
    """Shows `text` on standard error in place of the last one, where that is a terminal; the empty text ends it."""
    stream = beneath(sys.stderr)
    if stream is not None and stream.isatty():
        stream.write(f"\r{escaped(text)}" if text else "\n")
        stream.flush()


class _Shown:
    """A text stream. It has no descriptor and is no terminal: nobody may write past it, nor colour what it shows."""

    def __init__(self, stream: Any) -> None:
        self.beneath = stream
        self.encoding, self.errors = stream.encoding, stream.errors
        self._writing = threading.Lock()
        self._line_begins = True

    def write(self, text: str) -> int:
        with self._writing:
            lines = "\n".join(escaped(line) for line in text.split("\n"))
            marked = _PRIORITY.sub(" ", lines if self._line_begins else f"\x00{lines}").removeprefix("\x00")
            if text:
                self._line_begins = text.endswith("\n")
            self.beneath.write(marked)
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        self.beneath.flush()

    def isatty(self) -> bool:
        return False

    def writable(self) -> bool:
        return True
