"""What a process says: on the terminal, on the log, or to the program that calls it."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
import select
import shutil
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from splatnode.capture.process.text import LONGEST_TEXT, escape_text, sanitize_lines, sanitize_text

# What a verb prints reaches the terminal as text that only shows: the one place through which all of it goes.
#
# Every character but a line break is printable, so that no name or message moves the cursor, sets a title or turns the
# writing direction. A line that begins with "<0>", which the journal takes for a priority, is set in by a space.

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

    def tell_with_rest(step: ProgressStep | str) -> None:
        if isinstance(step, ProgressStep) and step.left_s is None:
            step = replace(step, left_s=remaining.estimate(step, time.monotonic()))
        tell(step)

    return tell_with_rest


class ProgressPrinter:
    """Shows steps on a terminal in place, with how long they took and will take.

    Elsewhere each is a line as it begins, and one each ten seconds for as long as it is heard of.
    """

    def __init__(self) -> None:
        self._step, self._began_s, self._shown_s = ProgressStep(""), 0.0, 0.0

    def __call__(self, step: ProgressStep | str) -> None:
        if isinstance(step, str):
            self._end_step()
            say(step)
            return
        now_s, begins = time.monotonic(), step.doing != self._step.doing
        if begins:
            self._end_step()
            self._began_s = now_s
        self._step = step
        if not is_interactive():
            if begins or (step.is_under_way and now_s >= self._shown_s + _LINE_EVERY_S):
                self._shown_s = now_s
                say(step.announcement if begins else step.sentence, error=True)
            return
        if begins:
            progress("")
        if begins or step.done == step.of or now_s >= self._shown_s + _SHOW_EVERY_S:
            self._shown_s = now_s
            progress(f"{step} ({format_times(step, now_s - self._began_s)})")

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
    printer = ProgressPrinter()
    with _each_second(printer.tick):
        yield printer


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


# Structured lines on stderr: `event=keyframe name=0042.png waiting=1`. The journal gets their priorities too.
#
# On a terminal they are for people: `16:35:44 keyframe: name 0042.png, waiting 1`.
#
# A record that `event` makes carries its fields to the formatter; a line is put together once, there, from values of
# one word or in quotes. No text in a record is read again, so none can pass for an event, a field, a line or a
# priority.

_PRIORITIES = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}
_LONGEST_VALUE = 4000  # characters; a status tells of 1000, and lists of names are longer
_LONGEST_TRACEBACK = 20_000


def use_structured_lines() -> None:
    """From now on every record of every room is one line: of key=value, or on a terminal with its time and in words."""
    if is_interactive():
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(TimedLines())
    else:
        handler = logging.StreamHandler(beneath(sys.stderr))
        handler.setFormatter(StructuredLines(journal="JOURNAL_STREAM" in os.environ))
    logging.getLogger().handlers = [handler]
    logging.captureWarnings(True)


def use_plain_lines() -> None:
    """From now on every record is its message alone, as a person reads it on a terminal."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PlainLines())
    logging.basicConfig(handlers=[handler])


def event(log: logging.Logger, level: int, what: str, **fields: object) -> None:
    """Logs that `what` happened; `what` and the names of the fields are the program's own words."""
    log.log(level, _Event(what, fields))


@dataclass(frozen=True)
class _Event:
    what: str
    fields: Mapping[str, object]

    def __str__(self) -> str:
        return " ".join(f"{key}={_value(value)}" for key, value in {"event": self.what, **self.fields}.items())

    @property
    def plain_text(self) -> str:
        """`another place: before scene-0001, now scene-0002`; fields that say nothing are left out."""
        parts = [f"{key} {_short(value)}" for key, value in self.fields.items() if value not in ("", None)]
        return ": ".join(filter(None, (self.what.replace("_", " "), ", ".join(parts))))


class StructuredLines(logging.Formatter):
    def __init__(self, journal: bool) -> None:
        super().__init__()
        self._journal = journal  # which adds the time, the process and the priority by itself

    def format(self, record: logging.LogRecord) -> str:
        what = record.msg if isinstance(record.msg, _Event) else _Event("log", {"message": record.getMessage()})
        text = str(what)
        if record.exc_info:
            text += f" exception={_quote_text(self.formatException(record.exc_info)[-_LONGEST_TRACEBACK:])}"
        if self._journal:
            return f"<{_PRIORITIES.get(record.levelno, 6)}>logger={record.name} {text}"
        return f"time={_value(self.formatTime(record))} level={record.levelname.lower()} logger={record.name} {text}"


class PlainLines(logging.Formatter):
    """The message, an event in words; lines after its first one are set in, so that none passes for a message."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return record.msg.plain_text if isinstance(record.msg, _Event) else super().formatMessage(record)

    def format(self, record: logging.LogRecord) -> str:
        return sanitize_lines(super().format(record))


class TimedLines(PlainLines):
    """As PlainLines, behind the time of day; and the level, where it is no mere information."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        level = f"{record.levelname.lower()}: " if record.levelno > logging.INFO else ""
        return f"{self.formatTime(record, '%H:%M:%S')} {level}{super().formatMessage(record)}"


def _value(value: object) -> str:
    """One word, or a quoted text on one line."""
    text = _short(value)
    plain = text and not any(letter.isspace() or letter in "\"'=" or not letter.isprintable() for letter in text)
    return text if plain else _quote_text(text)


def _short(value: object) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"


def _quote_text(text: str) -> str:
    marked = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escape_text(marked)}"'


# What went wrong and was overcome, for people: counted, and told until somebody has seen it.


class Problems:
    """Counts by kind, with the newest reason of each. To be used from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._totals: dict[str, int] = {}
        self._newest: dict[str, str] = {}
        self._seen: dict[str, int] = {}

    def add(self, kind: str, why: object) -> int:
        """One more of a `kind`, such as "frames that could not be examined"; returns how many there are now."""
        with self._lock:
            total = self._totals.get(kind, 0) + 1
            self._totals[kind], self._newest[kind] = total, sanitize_text(why)
            return total

    def count(self, kind: str, total: int, why: str) -> None:
        """So many of a `kind` are counted elsewhere."""
        with self._lock:
            self._totals[kind], self._newest[kind] = total, sanitize_text(why)

    def mark_seen(self) -> None:
        """Somebody has seen all that was told: it is not told again."""
        with self._lock:
            self._seen = dict(self._totals)

    def __str__(self) -> str:
        """One sentence for all that nobody has seen; empty where there is nothing."""
        with self._lock:
            unseen = {kind: total - self._seen.get(kind, 0) for kind, total in self._totals.items()}
            parts = [f"{count} {kind}, the last: {self._newest[kind]}" for kind, count in unseen.items() if count > 0]
        return sanitize_text("; ".join(parts), LONGEST_TEXT)


def is_logged(count: int) -> bool:
    """Whether the so manieth of a kind is logged: the 1st, 2nd, 4th, 8th, ..., so that nobody can fill the journal."""
    return count.bit_count() == 1


# What people are told of an input and no error tells: on the log, or to a program that calls as a Python warning.

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


# What is done again and again, such as a heartbeat, and must not end the process that does it.

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
