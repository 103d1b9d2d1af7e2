"""What a verb prints reaches the terminal as text that only shows: the one place through which all of it goes.

Every character but a line break is printable, so that no name or message moves the cursor, sets a title or turns the
writing direction. A line that begins with "<0>", which the journal takes for a priority, is set in by a space.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import select
import shutil
import sys
import threading
from collections.abc import Iterator
from typing import Any

from splatnode.capture.process.printable import escape_text

_PRIORITY = re.compile(r"^(?=<[0-9]*>)", re.MULTILINE)


@contextlib.contextmanager
def sanitize_output() -> Iterator[None]:
    """Standard output and error take only text in here; the streams that were there before are there again after."""
    before = sys.stdout, sys.stderr
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that a terminal cannot show costs no result
    line = _LineInPlace()
    sys.stdout, sys.stderr = (stream and _SanitizedStream(stream, line) for stream in before)  # None where it is closed
    try:
        yield
    finally:
        line.end()
        sys.stdout, sys.stderr = before


def beneath(stream: Any) -> Any:
    """The stream itself, for lines that are safe by the way in which they are made."""
    return stream.beneath if isinstance(stream, _SanitizedStream) else stream


def say(line: object, *, error: bool = False) -> None:
    """Prints `line` on standard output or error; a line break in it, which a name may have, is shown as an escape."""
    print(escape_text(str(line)), file=sys.stderr if error else sys.stdout, flush=True)


def is_output_closed() -> bool:
    """Whether standard output or error is a pipe whose reader has gone. From then on what they get is dropped."""
    closed = [stream for stream in (sys.stdout, sys.stderr) if stream is not None and _is_closed_pipe(stream)]
    for stream in closed:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, beneath(stream).fileno())  # what was not written yet goes there at the end of the process
        os.close(nowhere)
    return bool(closed)


def _is_closed_pipe(stream: Any) -> bool:
    poller = select.poll()
    try:
        poller.register(beneath(stream).fileno(), 0)  # an end without another end is told in any case
    except (OSError, ValueError):  # it has no descriptor
        return False
    return bool(poller.poll(0))


def is_interactive() -> bool:
    """Whether `progress` shows anything: standard error is a terminal."""
    return isinstance(sys.stderr, _SanitizedStream) and sys.stderr.beneath.isatty()


def progress(text: str) -> None:
    """Shows `text` on standard error in place of the last one, where that is a terminal; the empty text ends it.

    Whatever else is printed ends it, too.
    """
    if isinstance(sys.stderr, _SanitizedStream) and is_interactive():
        sys.stderr.line.show(sys.stderr.beneath, escape_text(text))


def refresh_progress(text: str) -> None:
    """Shows `text` in place of the last one, if that is still the last thing on the terminal."""
    if isinstance(sys.stderr, _SanitizedStream) and is_interactive():
        sys.stderr.line.show(sys.stderr.beneath, escape_text(text), anew=False)


def clear_progress() -> None:
    """Nothing is left of what `progress` showed last, if nothing was printed since."""
    if isinstance(sys.stderr, _SanitizedStream):
        sys.stderr.line.clear()


class _LineInPlace:
    """The one line of the terminal that is written again and again."""

    def __init__(self) -> None:
        self._stream: Any = None  # that the line is on while there is one
        self._length = 0
        self._writing = threading.Lock()

    def show(self, stream: Any, text: str, anew: bool = True) -> None:
        """Writes `text` over the last one, cut to the width of the terminal: a wrapped line could not be replaced.

        Where there is no last one, `anew` says whether a line begins.
        """
        if not text:
            self.end()
            return
        with self._writing:
            if self._stream is None and not anew:
                return
            text = text[: shutil.get_terminal_size().columns - 1]
            stream.write(f"\r{text.ljust(self._length)}")
            stream.flush()
            self._stream, self._length = stream, len(text)

    def clear(self) -> None:
        """Clears the line: what comes next is written in its place."""
        with self._writing:
            if self._stream is not None:
                self._stream.write(f"\r{' ' * self._length}\r")
                self._stream.flush()
            self._stream, self._length = None, 0

    def end(self) -> None:
        """Ends the line: what comes next begins on a line of its own."""
        with self._writing:
            if self._stream is not None:
                self._stream.write("\n")
                self._stream.flush()
            self._stream, self._length = None, 0


class _SanitizedStream:
    """A text stream. It has no descriptor and is no terminal: nobody may write past it, nor colour what it shows."""

    def __init__(self, stream: Any, line: _LineInPlace) -> None:
        self.beneath, self.line = stream, line
        self.encoding, self.errors = stream.encoding, stream.errors
        self._writing = threading.Lock()
        self._line_begins = True

    def write(self, text: str) -> int:
        if text:
            self.line.end()
        with self._writing:
            lines = "\n".join(escape_text(line) for line in text.split("\n"))
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
