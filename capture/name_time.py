"""When a photograph was taken, as its file's name tells: `1341847980.722988.png`, `IMG_20240131_154501.jpg`.

Robots name images by seconds, milli-, micro- or nanoseconds since 1970, telephones by date and time.
"""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone
from pathlib import PurePath

from splatnode.capture.stamp import Clock, Stamp

_NS = 10**9
_1970 = datetime(1970, 1, 1, tzinfo=timezone.utc)
# Seconds since 1970 with a fraction; without a point the number of digits tells the unit. From 2001 to 2033 they begin
# with 1, dates of this century with 2: no number can be read as both.
_SECONDS = re.compile(r"(?<![0-9])(1[0-9]{9})(?:\.([0-9]{1,9})|([0-9]{3}|[0-9]{6}|[0-9]{9}))(?![0-9])")
# A fraction of the second has three, six or nine digits.
_DATE_TIME = re.compile(
    r"(?<![0-9])(20[0-9]{2})([-_.:]?)([0-9]{2})\2([0-9]{2})(?:[-_.T ]| at )?([0-9]{2})([-_.:]?)([0-9]{2})\6([0-9]{2})"
    r"(?:[.,]?([0-9]{3}|[0-9]{6}|[0-9]{9}))?(?![0-9])(Z?)(?!\s?[ap]\.?m)",
    re.IGNORECASE,
)
_DIGIT = re.compile("[0-9]")


def name_time(name: str) -> Stamp | None:
    """The time in a file's name; None where it has none, or where the name can be read in two ways.

    It is in UTC where it is counted from 1970, or ends with Z; a date and a time without a zone are of a clock whose
    zone is not known. A name has one time, and no number behind it: then the time may be that of a whole sequence.
    """
    stem = PurePath(name).stem
    found = [*_SECONDS.finditer(stem), *_DATE_TIME.finditer(stem)]
    if len(found) != 1 or _DIGIT.search(stem, found[0].end()):
        return None
    return _parse_unix_time(found[0]) if found[0].re is _SECONDS else _parse_date(found[0])


def _parse_unix_time(found: re.Match[str]) -> Stamp:
    seconds, fraction, digits = found.groups()
    return Stamp(int(seconds) * _NS + _fraction_ns(fraction or digits), Clock.UTC)


def _parse_date(found: re.Match[str]) -> Stamp | None:
    year, _, month, day, hour, _, minute, second, fraction, zone = found.groups()
    try:
        shown = datetime(*map(int, (year, month, day, hour, minute, second)), tzinfo=timezone.utc)
    except ValueError:  # a day or an hour that is none: the number is something else
        return None
    ns = (shown - _1970) // timedelta(seconds=1) * _NS + _fraction_ns(fraction or "")
    return Stamp(ns, Clock.UTC if zone else Clock.LOCAL)


def _fraction_ns(digits: str) -> int:
    """Decimal digits of a second, at most nine, as nanoseconds."""
    return int(digits.ljust(9, "0"))
