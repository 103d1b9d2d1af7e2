"""When a photograph was taken, as its EXIF tells (EXIF 2.32, 4.6.5)."""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone

from splatnode.capture.exif import read_texts
from splatnode.capture.stamp import Clock, Stamp

DATE_TIME_ORIGINAL, SUB_SECONDS_ORIGINAL, OFFSET_ORIGINAL = 0x9003, 0x9291, 0x9011

_DATE_TIME = re.compile(r"([0-9]{4})[:-]([0-9]{2})[:-]([0-9]{2})[ T]([0-9]{2}):([0-9]{2}):([0-9]{2})")
_DIGITS = re.compile(r"[0-9]+")
_OFFSET = re.compile(r"([+-])([0-9]{2}):?([0-5][0-9])")
_WIDEST_OFFSET = timedelta(hours=15)  # between UTC and a time zone; the farthest is 14
_1970 = datetime(1970, 1, 1, tzinfo=timezone.utc)


def exif_time(tiff: bytes) -> Stamp | None:
    """The time of exposure, from bytes that begin with a TIFF header; None where they do not tell it.

    It is in UTC where the camera states its time zone. Of the sub-seconds, nine digits count.
    """
    texts = read_texts(tiff)
    shown = _DATE_TIME.fullmatch(texts.get(DATE_TIME_ORIGINAL, "").strip())
    if shown is None:
        return None
    offset = _offset(texts.get(OFFSET_ORIGINAL, "").strip())
    try:
        since = datetime(*map(int, shown.groups()), tzinfo=timezone.utc) - _1970 - (offset or timedelta())
    except ValueError:  # a day or an hour that is none: a camera whose clock was never set writes zeros
        return None
    ns = since // timedelta(seconds=1) * 10**9 + _sub_seconds_ns(texts.get(SUB_SECONDS_ORIGINAL, "").strip())
    return Stamp(ns, Clock.LOCAL if offset is None else Clock.UTC) if ns >= 0 else None


def _sub_seconds_ns(text: str) -> int:
    """The decimal digits after the full second, as nanoseconds; 0 where they are none."""
    return int(text[:9].ljust(9, "0")) if _DIGITS.fullmatch(text) else 0


def _offset(text: str) -> timedelta | None:
    """Parses the offset of the camera's time zone from UTC; None where the camera does not state it."""
    found = _OFFSET.fullmatch(text)
    if found is None:
        return None
    sign, hours, minutes = found.groups()
    offset = timedelta(hours=int(hours), minutes=int(minutes))
    if offset > _WIDEST_OFFSET:
        return None
    return -offset if sign == "-" else offset
