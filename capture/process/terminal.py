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
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from splatnode.capture.process.text import escape_text

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


# What a verb is doing, for whoever waits for it: steps with how many of how many, and what was found.

_SHOW_EVERY_S = 0.1  # at most so often in place
_TICK_S = 1.0  # between looks at the seconds of a step that is not heard of
_TELLS_S = 1.0  # from so many seconds on a step tells how long the rest will take
_LINE_EVERY_S = 10.0  # where lines cannot be replaced, a step that goes on says so this often
_MINUTES_FROM_S = 100.0  # longer times are told in minutes

Item = TypeVar("Item")


@dataclass(frozen=True)
class ProgressStep:
    """A part of the work that is under way."""

    doing: str  # "matching"
    done: int = 0  # things that were counted so far
    of: int = 0  # 0: nobody knows, or there is nothing to count
    what: str = ""  # one of the things that are counted: "photograph pair"
    left_s: float | None = None  # until all of it is done, by the rate that was measured; None: nothing tells it

    def __str__(self) -> str:
        """`matching: 3 of 10 photograph pairs`."""
        if self.of:
            return f"{self.doing}: {self.done} of {_format_count(self.of, self.what)}"
        return f"{self.doing}: {_format_count(self.done, self.what)}" if self.done else self.doing

    @property
    def sentence(self) -> str:
        """`matching: 3 of 10 photograph pairs, about 6 s left`."""
        return str(self) if self.left_s is None else f"{self}, about {format_duration(self.left_s)} left"

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


class RemainingTime:
    """Estimates how long the rest of a step takes, by the rate of the newer half of what is done.

    The first things of a step say little of the last ones: images are loaded, and scenes grow.
    """

    def __init__(self) -> None:
        self._doing, self._of, self._first = "", 0, 0
        self._heard: deque[tuple[float, int]] = deque()  # when so many were done: of the newer half, and one before

    def estimate(self, step: ProgressStep, now_s: float) -> float | None:
        """Seconds until all of the step is done; None as long as nothing was measured of it for a second."""
        heard = self._heard
        if (step.doing, step.of) != (self._doing, self._of) or (heard and step.done < heard[-1][1]):
            self._doing, self._of, self._first = step.doing, step.of, step.done
            heard.clear()
        if not heard or step.done > heard[-1][1]:
            heard.append((now_s, step.done))
        last_s, last = heard[-1]
        while len(heard) > 2 and 2 * heard[1][1] <= self._first + last and last_s - heard[1][0] >= _TELLS_S:
            heard.popleft()
        since_s, since = heard[0]
        if not 0 < step.done < step.of or last == since or last_s - since_s < _TELLS_S:
            return None
        return max(0.0, (last_s - since_s) / (last - since) * (step.of - last) - (now_s - last_s))


def add_remaining_time(tell: Tell) -> Tell:
    """Returns what hears steps as `tell` does, each with the seconds that remain of it once they can be told."""
    if tell is ignore_progress:
        return tell
    remaining = RemainingTime()

    def tell_with_rest(told: ProgressStep | str) -> None:
        if isinstance(told, ProgressStep) and told.left_s is None:
            told = replace(told, left_s=remaining.estimate(told, time.monotonic()))
        tell(told)

    return tell_with_rest


class ProgressPrinter:
    """Shows steps on a terminal in place, with how long they took and will take.

    Elsewhere each is a line as it begins, and one each ten seconds for as long as it is heard of.
    """

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
            if begins or (told.is_under_way and now_s >= self._shown_s + _LINE_EVERY_S):
                self._shown_s = now_s
                say(told.announcement if begins else told.sentence, error=True)
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
    """`4 s, about 32 s left`: by the step's own measurement, else as long for each as what is done took."""
    taken = f"{taken_s:.0f} s"
    if taken_s < _TELLS_S or not 0 < step.done < step.of:
        return taken
    left_s = taken_s / step.done * (step.of - step.done) if step.left_s is None else step.left_s
    return f"{taken}, about {format_duration(left_s)} left"


def format_duration(seconds: float) -> str:
    """`32 s`, and from a hundred seconds on `5 min`."""
    return f"{seconds:.0f} s" if seconds < _MINUTES_FROM_S else f"{seconds / 60:.0f} min"


def _format_count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
