"""The few EXIF tags that tell about the camera, read from the TIFF structure that holds them (EXIF 2.32, 4.6)."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta, timezone
from pathlib import PurePath

from splatnode.capture.frame import Clock, ExposureSettings, Intrinsics, Stamp, parse_exposure

IMAGE_WIDTH, IMAGE_LENGTH = 0x0100, 0x0101
EXIF_IFD = 0x8769
FOCAL_LENGTH = 0x920A  # mm
PIXEL_X_DIMENSION, PIXEL_Y_DIMENSION = 0xA002, 0xA003
FOCAL_PLANE_X_RESOLUTION, FOCAL_PLANE_RESOLUTION_UNIT = 0xA20E, 0xA210
FOCAL_LENGTH_35MM = 0xA405
EXPOSURE_TIME, F_NUMBER = 0x829A, 0x829D  # seconds; focal length over aperture
PHOTOGRAPHIC_SENSITIVITY = 0x8827  # ISO
MAKE, MODEL, LENS_MODEL = 0x010F, 0x0110, 0xA434
DIGITAL_ZOOM_RATIO = 0xA404

Tags = Mapping[int, tuple[float, ...]]

_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_ASPECT_TOLERANCE = 0.02  # relative; cameras round sides to whole blocks of pixels, and a crop changes more
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
_MOST_VALUES = 16  # of a tag; texts, thumbnails and maker notes have more
_ASCII, _LONGEST_TEXT = 2, 64  # TIFF type; characters
_MOST_SENSITIVE = 65_535  # it has 16 bits: this value says that the sensitivity is beyond them (EXIF 2.32, 4.6.5)
_FORMATS = {1: "B", 3: "H", 4: "I", 5: "II", 8: "h", 9: "i", 10: "ii"}  # TIFF type -> struct codes of one value
# From a fisheye to a long telephoto lens; what lies outside is a wrong tag.
_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}  # byte order of struct, by how a TIFF structure begins
_PLAUSIBLE_FOCAL = (0.2, 12.0)  # in longer image sides


def read_tags(tiff: bytes) -> Tags:
    """Numeric tags of the first image and its EXIF part, from bytes that begin with a TIFF header.

    What cannot be parsed is left out: EXIF is a hint that an image may lack, and many programs damage it.
    """
    order = _ORDERS.get(tiff[:4])
    if order is None:
        return {}
    try:
        tags = read_directory(tiff, struct.unpack_from(order + "I", tiff, 4)[0], order)
        if (part := first(tags, EXIF_IFD)) is not None:
            tags |= read_directory(tiff, int(part), order)
    except struct.error:  # an offset points outside
        return {}
    return tags


def read_directory(tiff: bytes, offset: int, order: str) -> dict[int, tuple[float, ...]]:
    """The numeric tags of the directory at `offset`, in the byte order `order` of struct. Raises struct.error."""
    tags: dict[int, tuple[float, ...]] = {}
    for tag, kind, count, entry in _entries(tiff, offset, order):
        if kind not in _FORMATS or not 1 <= count <= _MOST_VALUES:
            continue
        layout = struct.Struct(order + _FORMATS[kind] * count)
        values = layout.unpack_from(tiff, _start(tiff, entry, layout.size, order))
        if len(_FORMATS[kind]) == 2:
            values = tuple(p / q if q else math.nan for p, q in zip(values[::2], values[1::2], strict=True))
        tags[tag] = values
    return tags


def read_texts(tiff: bytes) -> dict[int, str]:
    """The short texts of the EXIF part, by tag. What cannot be parsed is left out, as in `read_tags`."""
    order, part = _ORDERS.get(tiff[:4]), first(read_tags(tiff), EXIF_IFD)
    if order is None or part is None:
        return {}
    texts: dict[int, str] = {}
    try:
        for tag, kind, count, entry in _entries(tiff, int(part), order):
            if kind == _ASCII and 1 <= count <= _LONGEST_TEXT:
                start = _start(tiff, entry, count, order)
                texts[tag] = tiff[start : start + count].partition(b"\0")[0].decode("ascii", "replace")
    except struct.error:
        return {}
    return texts


def camera_identity(tiff: bytes) -> str:
    """Which camera took a photograph, through which lens, at which focal length and digital zoom; empty if not told.

    Photographs of different identities share no lens. Those of one identity may.
    """
    order = _ORDERS.get(tiff[:4])
    if order is None:
        return ""
    texts: dict[int, str] = dict(read_texts(tiff))
    try:
        for tag, kind, count, entry in _entries(tiff, struct.unpack_from(order + "I", tiff, 4)[0], order):
            if tag in (MAKE, MODEL) and kind == _ASCII and 1 <= count <= _LONGEST_TEXT:
                start = _start(tiff, entry, count, order)
                texts[tag] = tiff[start : start + count].partition(b"\0")[0].decode("ascii", "replace")
    except struct.error:
        return ""
    names = [texts.get(tag, "").strip() for tag in (MAKE, MODEL, LENS_MODEL)]
    if not any(names):
        return ""
    tags = read_tags(tiff)
    numbers = [f"{first(tags, tag) or 0.0:.3g}" for tag in (FOCAL_LENGTH, FOCAL_LENGTH_35MM, DIGITAL_ZOOM_RATIO)]
    return "|".join([*names, *numbers])


def _entries(tiff: bytes, offset: int, order: str) -> Iterator[tuple[int, int, int, int]]:
    """Tag, type, number of values and place of each entry of the directory at `offset`. Raises struct.error."""
    (entries,) = struct.unpack_from(order + "H", tiff, offset)
    for entry in range(offset + 2, offset + 2 + 12 * entries, 12):
        yield *struct.unpack_from(order + "HHI", tiff, entry), entry


def _start(tiff: bytes, entry: int, size: int, order: str) -> int:
    """Returns the offset of an entry's values: in the entry if they have room there. Raises struct.error."""
    return entry + 8 if size <= 4 else struct.unpack_from(order + "I", tiff, entry + 8)[0]


def exif_intrinsics(tags: Tags, width: int, height: int) -> Intrinsics | None:
    """The nominal camera of an image of `width` x `height` pixels; None where the tags do not tell it.

    The principal point is taken to be the centre. Tags are not believed where the image was cropped after it was
    taken or the focal length is not that of a real lens.
    """
    taken = sorted((first(tags, PIXEL_X_DIMENSION) or width, first(tags, PIXEL_Y_DIMENSION) or height))
    shorter, longer = sorted((width, height))  # sorted: programs that turn an image do not always turn its tags
    if abs(taken[0] * longer / (taken[1] * shorter) - 1) > _ASPECT_TOLERANCE:
        return None
    focal = _focal_from_35mm(tags, width, height) or _focal_from_sensor(tags, longer / taken[1])
    if focal is None or not _PLAUSIBLE_FOCAL[0] <= focal / longer <= _PLAUSIBLE_FOCAL[1]:
        return None
    return Intrinsics(width, height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, source="exif")


def exif_exposure(tags: Tags) -> ExposureSettings | None:
    """How the photograph was exposed; None where the tags do not tell time and sensitivity."""
    sensitivity = first(tags, PHOTOGRAPHIC_SENSITIVITY)
    if sensitivity == _MOST_SENSITIVE:
        return None
    return parse_exposure(first(tags, EXPOSURE_TIME), sensitivity, first(tags, F_NUMBER))


def _focal_from_35mm(tags: Tags, width: int, height: int) -> float | None:
    """Pixels. The equivalent focal length compares diagonals (CIPA DCG-001), so that it holds for 4:3 sensors too."""
    focal_mm = first(tags, FOCAL_LENGTH_35MM)
    return focal_mm * math.hypot(width, height) / _FILM_DIAGONAL_MM if focal_mm else None


def _focal_from_sensor(tags: Tags, resized: float) -> float | None:
    """Pixels, from the lens and the sensor's pixels per unit of length, for an image `resized` times its taken size."""
    focal_mm, per_unit = first(tags, FOCAL_LENGTH), first(tags, FOCAL_PLANE_X_RESOLUTION)
    mm_per_unit = _MM_PER_UNIT.get(int(first(tags, FOCAL_PLANE_RESOLUTION_UNIT) or 2))
    if not focal_mm or not per_unit or not mm_per_unit:
        return None
    return focal_mm / mm_per_unit * per_unit * resized * (first(tags, DIGITAL_ZOOM_RATIO) or 1.0)


def first(tags: Tags, tag: int) -> float | None:
    """The tag's first value; None where it is absent or says "unknown" (zero, negative, 0/0)."""
    value = tags.get(tag, (0.0,))[0]
    return float(value) if value > 0 and math.isfinite(value) else None


# When a photograph was taken, as its EXIF tells (EXIF 2.32, 4.6.5).

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


# When a photograph was taken, as its file's name tells: `1341847980.722988.png`, `IMG_20240131_154501.jpg`.
#
# Robots name images by seconds, milli-, micro- or nanoseconds since 1970, telephones by date and time.

_NS = 10**9
# Seconds since 1970 with a fraction; without a point the number of digits tells the unit. From 2001 to 2033 they begin
# with 1, dates of this century with 2: no number can be read as both.
_SECONDS = re.compile(r"(?<![0-9])(1[0-9]{9})(?:\.([0-9]{1,9})|([0-9]{3}|[0-9]{6}|[0-9]{9}))(?![0-9])")
# A fraction of the second has three, six or nine digits.
_DATE_TIME_IN_NAME = re.compile(
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
    found = [*_SECONDS.finditer(stem), *_DATE_TIME_IN_NAME.finditer(stem)]
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
