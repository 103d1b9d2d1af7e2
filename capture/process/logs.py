"""Structured lines on stderr: `event=keyframe name=0042.png waiting=1`. The journal gets their priorities too.

On a terminal they are for people: `16:35:44 keyframe: name 0042.png, waiting 1`.

A record that `event` makes carries its fields to the formatter; a line is put together once, there, from values of one
word or in quotes. No text in a record is read again, so none can pass for an event, a field, a line or a priority.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass

from splatnode.capture.process.terminal import beneath, is_interactive
from splatnode.capture.process.text import LONGEST_TEXT, escape_text, sanitize_lines, sanitize_text

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
        told = [f"{key} {_short(value)}" for key, value in self.fields.items() if value not in ("", None)]
        return ": ".join(filter(None, (self.what.replace("_", " "), ", ".join(told))))


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
            told = [f"{count} {kind}, the last: {self._newest[kind]}" for kind, count in unseen.items() if count > 0]
        return sanitize_text("; ".join(told), LONGEST_TEXT)


def is_logged(count: int) -> bool:
    """Whether the so manieth of a kind is logged: the 1st, 2nd, 4th, 8th, ..., so that nobody can fill the journal."""
    return count.bit_count() == 1
