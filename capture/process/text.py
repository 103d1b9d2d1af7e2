"""Text is text: what a stranger named or said, as characters that a log, a terminal, a page and a window only show."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import re
from collections.abc import Iterator

LONGEST_NAME = 255  # characters, as of a file
LONGEST_TEXT = 1000  # characters of a message
MAX_NUMBER = 2**31  # either side of 0: of a configuration or an argument
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


# The boundary of a process: what a stranger wrote becomes a typed value, or that boundary's own error.


@contextlib.contextmanager
def guard_untrusted(refusal: type[Exception], source: object = "") -> Iterator[None]:
    """Whatever fails in here is the fault of `source`, a file or a sender, and is raised as a `refusal` that names it.

    For the code that reads a stranger's bytes, and for nothing else: a parser meets what its author did not think of,
    and what it then raises (OverflowError, RecursionError, an IndexError of a library) is no error of the process.
    A refusal that is one already is left as it is, and so is an OSError: that the disk does not give the bytes is not
    the fault of what they say. Whether memory lacked, `may_be_shortage` tells of the refusal.
    """
    try:
        yield
    except (refusal, OSError):
        raise
    except Exception as error:
        where = f"{source}: " if source else ""
        raise refusal(f"{where}cannot be read ({type(error).__name__}: {sanitize_text(error)})") from error


# Lengths as people write them, with their unit: 100mm, 10 cm, 0.1m.

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m)\s*", re.ASCII)
_LONGEST = 1000.0  # metres


def metres(text: str) -> float:
    """The length in metres. Raises ValueError where it has no unit or is not above 0."""
    found = _LENGTH.fullmatch(text[:100])
    length = float(found[1]) * _METRES[found[2]] if found else 0.0
    if not 0.0 < length <= _LONGEST:
        raise ValueError(f"a length must have its unit, as 100mm, 10cm or 0.1m, and be above 0; got {text[:100]!a}")
    return length


def parse_measurement(text: str) -> tuple[float, float | None]:
    """A length and its standard deviation in metres, as 100mm@0.2mm; None where there is none. Raises ValueError."""
    length, at, sigma = text.partition("@")
    return metres(length), metres(sigma) if at else None


def measurement_argument(text: str) -> str:
    """The text, for an argument of the command line that `parse_measurement` reads."""
    try:
        parse_measurement(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text.strip()


def metres_argument(text: str) -> float:
    """As `metres`, for an argument of the command line."""
    try:
        return metres(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def format_length(length_m: float) -> str:
    """The length in the unit that suits it: 100 mm, 1.5 m."""
    return f"{length_m:g} m" if length_m >= 1.0 else f"{1e3 * length_m:g} mm"
