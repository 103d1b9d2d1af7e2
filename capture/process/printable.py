"""Text is text: what a stranger named or said, as characters that a log, a terminal, a page and a window only show."""

from __future__ import annotations

import hashlib

LONGEST_NAME = 255  # characters, as of a file
LONGEST_TEXT = 1000  # characters of a message
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")  # the last: as wide as a word
LONGEST_LINE = 4000  # characters of one of several lines: a reason that names files and what was expected


def sanitize_text(text: object, longest: int = LONGEST_TEXT) -> str:
    """`text` on one line without control, format, bidirectional or private characters, which are written as escapes.

    The escapes are Python's: a line break is \\n, the beginning of a terminal's command \\x1b, a change of the writing
    direction \\u202e, a byte of a file's name that is no UTF-8 \\udcff. What is printable already comes back as it is;
    of more than `longest` characters the end is left out.
    """
    shown = escape_text(str(text)[: longest + 1])
    return shown if len(shown) <= longest else shown[: longest - 1] + "…"


def is_printable(text: str, longest: int = LONGEST_TEXT) -> bool:
    """Whether `sanitize_text` gives `text` back as it is."""
    return len(text) <= longest and text.isprintable()


def sanitize_lines(text: object) -> str:
    """`text` of several lines, each printable; those after the first are set in by two spaces.

    So a line that a stranger's line break began is told from one of the program's own. Of one with more than
    LONGEST_LINE characters the end is left out.
    """
    lines = str(text).rstrip("\n").split("\n")
    return "\n  ".join(sanitize_text(line, LONGEST_LINE) for line in lines)


def sanitize_name(raw: str, longest: int = LONGEST_NAME) -> str:
    """The name `raw` of a file as `sanitize_text` shows it; two names that differ stay two.

    So a backslash is escaped, too, and of a name that is too long the end is replaced by a digest of the whole.
    """
    name = escape_text(raw.replace("\\", "\\\\"))
    return name if len(name) <= longest else digest_name(raw, longest)


def digest_name(raw: str, longest: int = LONGEST_NAME) -> str:
    """The beginning of `raw` as `sanitize_text` shows it, and a digest of the whole: no other name becomes this one."""
    digest = hashlib.blake2b(raw.encode(errors="surrogatepass"), digest_size=8).hexdigest()
    return f"{escape_text(raw)[: longest - len(digest) - 1]}~{digest}"


def escape_text(text: str) -> str:
    """`text` with what is not printable as escapes, however long it is."""
    return "".join(letter if letter.isprintable() else _escape(letter) for letter in text)


def _escape(letter: str) -> str:
    return letter.encode("unicode_escape").decode()


def cell(value: object) -> object:
    """`value` for a table that a spreadsheet may open: text that it would compute, such as =1+1, gets a quote."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
