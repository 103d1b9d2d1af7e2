"""Text is text: what a stranger named or said, as characters that a log, a terminal, a page and a window only show."""

from __future__ import annotations

LONGEST_NAME = 255  # characters, as of a file
LONGEST_TEXT = 1000  # characters of a message


def printable(text: object, longest: int = LONGEST_TEXT) -> str:
    """`text` on one line without control, format, bidirectional or private characters, which are written as escapes.

    The escapes are Python's: a line break is \\n, the beginning of a terminal's command \\x1b, a change of the writing
    direction \\u202e, a byte of a file's name that is no UTF-8 \\udcff. What is printable already comes back as it is;
    of more than `longest` characters the end is left out.
    """
    escaped = "".join(letter if letter.isprintable() else _escape(letter) for letter in str(text)[: longest + 1])
    return escaped if len(escaped) <= longest else escaped[: longest - 1] + "…"


def is_printable(text: str, longest: int = LONGEST_TEXT) -> bool:
    """Whether `printable` gives `text` back as it is."""
    return len(text) <= longest and text.isprintable()


def _escape(letter: str) -> str:
    return letter.encode("unicode_escape").decode()
