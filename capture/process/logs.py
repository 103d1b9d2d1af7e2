"""Structured lines on stderr: `event=keyframe name=0042.png waiting=1`. The journal gets their priorities too."""

from __future__ import annotations

import logging
import os
import sys

_PRIORITIES = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


def use_structured_lines() -> None:
    """From now on every record of every room is one line of key=value."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Formatter(journal="JOURNAL_STREAM" in os.environ))
    logging.getLogger().handlers = [handler]


def event(log: logging.Logger, level: int, what: str, **fields: object) -> None:
    """Logs that `what` happened."""
    log.log(level, "%s", " ".join(f"{key}={_value(value)}" for key, value in {"event": what, **fields}.items()))


class _Formatter(logging.Formatter):
    def __init__(self, journal: bool) -> None:
        super().__init__()
        self._journal = journal  # which adds the time, the process and the priority by itself

    def format(self, record: logging.LogRecord) -> str:
        message = record.getMessage()
        text = message if message.startswith("event=") else f"event=log message={_value(message)}"
        if record.exc_info:
            text += f" exception={_value(self.formatException(record.exc_info))}"
        if self._journal:
            return f"<{_PRIORITIES.get(record.levelno, 6)}>logger={record.name} {text}"
        return f"time={_value(self.formatTime(record))} level={record.levelname.lower()} logger={record.name} {text}"


def _value(value: object) -> str:
    """One word, or a quoted text on one line."""
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    plain = text and not any(letter.isspace() or letter in "\"'=" or not letter.isprintable() for letter in text)
    return text if plain else '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") + '"'
