"""Bytes of an image file -> its one size, its EXIF part and what that tells, and the bytes that a decoder gets.

A decoder takes memory for the size that it finds, and where a file states two, it may find the other one. So the
structure of every format is walked to its end here: a file whose size is stated twice, or where a decoder could look
for it at another place, is refused; and what a picture needs no decoder for (texts, profiles, animations of a PNG) is
left out of what the decoder gets. Of EXIF the few tags are read that tell about the camera, from the TIFF structure
that holds them (EXIF 2.32, 4.6).
"""

from __future__ import annotations

import math
import re
import resource
import struct
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from pathlib import PurePath

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Clock, ExposureSettings, Intrinsics, Stamp, parse_exposure
from splatnode.capture.process import python

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


MAX_SIDE = 65_535  # pixels; JPEG cannot state more
_MAX_PARTS = 1_000_000  # segments or chunks of a file; PNG has one in 8 KB at most, as a rule


class UnusableImage(Exception):
    """The bytes hold no image that can be used; the message says why."""


@dataclass(frozen=True)
class ImageHeader:
    width: int  # as stored, before the EXIF orientation is applied
    height: int
    exif: bytes = field(default=b"", repr=False)  # a TIFF structure
    decodable: bytes = field(default=b"", repr=False)  # the file, without what a decoder does not need
    bits: int = 8  # of a channel: up to 16
    has_alpha: bool = False  # whether a channel, or a colour, tells what is transparent
    is_premultiplied: bool = False  # whether the colours are stored multiplied by alpha
    turns_itself: bool = False  # whether decoders turn the image upright though they were told not to


def read_header(data: bytes) -> ImageHeader:
    """Size and EXIF of a JPEG, PNG, WebP, TIFF, BMP, PPM or PGM file that is complete. Raises UnusableImage.

    No side is 0 or above MAX_SIDE.
    """
    if not data:
        raise UnusableImage("empty file")
    readers: dict[bytes, Callable[[bytes], ImageHeader]] = {
        b"\xff\xd8\xff": _jpeg_header,
        b"\x89PNG\r\n\x1a\n": _png_header,
        b"RIFF": _webp_header,
        b"II*\0": _tiff_header,
        b"MM\0*": _tiff_header,
        b"BM": _bmp_header,
        **dict.fromkeys((b"P2", b"P3", b"P5", b"P6"), _pnm_header),
    }
    for magic, reader in readers.items():
        if data.startswith(magic):
            try:
                header = reader(data)
            except struct.error as error:  # the structure points beyond the end
                raise UnusableImage("truncated: the file ends early") from error
            if not 1 <= min(header.width, header.height) <= max(header.width, header.height) <= MAX_SIDE:
                size = f"{header.width} x {header.height}"
                raise UnusableImage(f"{size}: each side must have 1 to {MAX_SIDE} pixels; resize or cut it")
            return header
    raise UnusableImage(f"not an image: no JPEG, PNG, WebP, TIFF, BMP, PPM or PGM begins with {data[:4].hex(' ')}")


def image_kind(start: bytes) -> str | None:
    """The kind of image file that begins with these bytes, 16 of them suffice; None where none is known that does."""
    kinds = {
        b"\xff\xd8\xff": "JPEG",
        b"\x89PNG\r\n\x1a\n": "PNG",
        b"II*\0": "TIFF",
        b"MM\0*": "TIFF",
        b"GIF8": "GIF",
        b"\0\0\0\x0cjP  ": "JPEG 2000",
        b"\xff\x4f\xff\x51": "JPEG 2000",
        b"\0\0\0\x0cJXL ": "JPEG XL",
        b"8BPS": "Photoshop",
    }
    if start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        return "WebP"
    if start[4:8] == b"ftyp" and start[8:12] in (b"heic", b"heix", b"mif1", b"avif"):
        return "HEIC or AVIF"
    return next((kind for magic, kind in kinds.items() if start.startswith(magic)), None)


_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # in entropy-coded data, FF 00 and FF D0..D7 are no markers
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # start of frame: every coding process
_JPEG_TABLES = {0xC4, 0xCC, 0xDB, 0xDD}  # Huffman, arithmetic, quantisation, restart interval
_JPEG_SCAN, _JPEG_END, _JPEG_APP1 = 0xDA, 0xD9, 0xE1
_JPEG_REMARKS = {*range(0xE0, 0xF0), 0xFE}  # for applications, and comments
_MAX_SCANS = 100  # each is a pass over the whole image; encoders write up to about ten


def _jpeg_header(data: bytes) -> ImageHeader:
    """Walks all segments to the end-of-image marker (ITU-T T.81, annex B), which a truncated file lacks.

    Markers that would let a decoder continue elsewhere (a second start, those without a length) have no use in a file.
    """
    size, tiff, position, parts, scans = None, b"", 2, 0, 0
    while match := _JPEG_MARKER.search(data, position):
        marker, parts = match.group()[1], parts + 1
        if marker == _JPEG_END:
            if size is None:
                raise UnusableImage("damaged: a JPEG without an image")
            return ImageHeader(*size, exif=tiff, decodable=data)
        (length,) = struct.unpack_from(">H", data, match.end())
        segment = data[match.end() + 2 : match.end() + length]
        if marker in _JPEG_FRAMES:
            if size is not None:
                raise UnusableImage("damaged: the JPEG states its size twice")
            height, width = struct.unpack_from(">HH", segment, 1)
            size = width, height
        elif marker == _JPEG_SCAN:
            scans += 1
        elif marker == _JPEG_APP1 and segment.startswith(b"Exif\0\0"):
            tiff = tiff or segment[6:]
        elif marker not in _JPEG_TABLES | _JPEG_REMARKS:
            raise UnusableImage(f"damaged: no JPEG file has a marker {marker:#x}")
        if length < 2 or parts > _MAX_PARTS or scans > _MAX_SCANS:
            raise UnusableImage(f"damaged: a JPEG of up to {_MAX_SCANS} scans and {_MAX_PARTS} segments was expected")
        position = match.end() + length
    raise UnusableImage("truncated: the JPEG has no end-of-image marker")


_PNG_START = 8
_PNG_WITH_ALPHA = {4, 6}  # colour types: grey, and colours
_PNG_NEEDED = {b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"eXIf", b"IEND"}  # eXIf: the orientation


def _png_header(data: bytes) -> ImageHeader:
    """Chunks (PNG, third edition): IHDR comes first and once. Texts and profiles are left out: they are compressed."""
    tiff, position, kept, has_pixels = b"", _PNG_START, [data[:_PNG_START]], False
    width, height, bits, colours = struct.unpack_from(">IIBB", data, _PNG_START + 8)
    has_alpha = colours in _PNG_WITH_ALPHA
    for part in range(_MAX_PARTS):
        length, kind = struct.unpack_from(">I4s", data, position)
        if (kind == b"IHDR") != (part == 0) or (part == 0 and length != 13):
            raise UnusableImage("damaged: a PNG must state its size once, at its beginning")
        if position + 12 + length > len(data):
            raise UnusableImage("truncated: the file ends early")
        if kind in _PNG_NEEDED and not (kind == b"eXIf" and tiff):
            kept.append(data[position : position + 12 + length])
        if kind == b"IEND":
            if not has_pixels:
                raise UnusableImage("damaged: a PNG without an image")
            return ImageHeader(width, height, tiff, b"".join(kept), max(8, bits), has_alpha)
        has_pixels = has_pixels or kind == b"IDAT"
        has_alpha = has_alpha or kind == b"tRNS"
        if kind == b"eXIf":
            tiff = tiff or data[position + 8 : position + 8 + length]
        position += 12 + length
    raise UnusableImage(f"damaged: a PNG of at most {_MAX_PARTS} chunks was expected")


def _webp_header(data: bytes) -> ImageHeader:
    """RIFF chunks (RFC 9649): VP8X, or the only VP8 or VP8L, comes first; with VP8X, the image has the same size."""
    riff_size, form = struct.unpack_from("<I4s", data, 4)
    if form != b"WEBP":
        raise UnusableImage("not an image: a RIFF file that is not WebP")
    if riff_size + 8 > len(data):
        raise UnusableImage("truncated: the file ends early")
    size, tiff, position, parts, has_alpha = None, b"", 12, 0, False
    while position + 8 <= riff_size + 8:
        kind, length = struct.unpack_from("<4sI", data, position)
        body = data[position + 8 : position + 8 + length]
        stated = _webp_size(kind, body)
        if position == 12:
            size = stated
        elif kind == b"VP8X" or stated not in (None, size):
            raise UnusableImage(f"damaged: the WebP states its size twice, {size} and {stated}")
        has_alpha = has_alpha or _webp_has_alpha(kind, body)
        if kind == b"EXIF":
            tiff = tiff or body.removeprefix(b"Exif\0\0")
        position, parts = position + 8 + length + length % 2, parts + 1
        if size is None or parts > _MAX_PARTS:
            raise UnusableImage(f"damaged: a WebP must begin with its size and have at most {_MAX_PARTS} chunks")
    if size is None:
        raise UnusableImage("damaged: a WebP without an image")
    return ImageHeader(*size, exif=tiff, decodable=data[: riff_size + 8], has_alpha=has_alpha)


def _webp_has_alpha(kind: bytes, body: bytes) -> bool:
    """Whether a chunk of this kind says that there is alpha."""
    if kind == b"VP8L":
        return bool(int.from_bytes(body[1:5], "little") >> 28 & 1)
    return kind == b"ALPH"


def _webp_size(kind: bytes, body: bytes) -> tuple[int, int] | None:
    """Width and height, where a chunk of this kind states them."""
    if kind == b"VP8X":
        if len(body) < 10:
            raise UnusableImage("truncated: the file ends early")
        return 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
    if kind == b"VP8L":
        bits = int.from_bytes(body[1:5], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", body, 6)
        return width & 0x3FFF, height & 0x3FFF
    return None


_TIFF_SIZES = {  # name -> tag and largest value
    "ImageWidth": (IMAGE_WIDTH, MAX_SIDE),
    "ImageLength": (IMAGE_LENGTH, MAX_SIDE),
    "BitsPerSample": (258, 16),
    "SamplesPerPixel": (277, 4),
    "RowsPerStrip": (278, 2**32 - 1),
    "TileWidth": (322, 2**32 - 1),
    "TileLength": (323, 2**32 - 1),
}
_TIFF_PHOTOMETRIC, _TIFF_RGB = 262, 2
_TIFF_EXTRA = 338  # ExtraSamples: what the channels beside the colours are
_ASSOCIATED, _UNASSOCIATED = 1, 2  # alpha by which colours are multiplied, and not
_TIFF_DEPTHS = {32997, 32998}  # of volumes, by which libtiff multiplies sizes
_TIFF_SHORT = 3
_TIFF_WHOLE = {1, 3, 4}  # types BYTE, SHORT and LONG
_MAX_TILE = 1 << 22  # pixels of a tile or a strip, unless the image has more


def _tiff_header(data: bytes) -> ImageHeader:
    """The first directory (TIFF 6.0): no tag twice, and no tile or strip that is larger than its image."""
    order = "<" if data.startswith(b"II") else ">"
    (offset,) = struct.unpack_from(order + "I", data, 4)
    (entries,) = struct.unpack_from(order + "H", data, offset)
    rows = [struct.unpack_from(order + "HHI", data, offset + 2 + 12 * entry) for entry in range(entries)]
    kinds = {tag: (kind, count) for tag, kind, count in rows}
    if len(kinds) < entries or _TIFF_DEPTHS & kinds.keys():
        raise UnusableImage("damaged: the TIFF has a tag twice, or is of a volume")
    values = read_directory(data, offset, order)
    sizes: dict[str, int] = {}
    for name, (tag, most) in _TIFF_SIZES.items():
        if tag not in kinds:
            continue
        kind, count = kinds[tag]
        given = values.get(tag, ())
        if kind not in _TIFF_WHOLE or (count > 1 and name != "BitsPerSample") or not given or max(given) > most:
            raise UnusableImage(f"the TIFF's {name} must be a whole number of at most {most}, is {given[:4]}")
        sizes[name] = int(max(given))
    if not {"ImageWidth", "ImageLength"} <= sizes.keys():
        raise UnusableImage("truncated: the TIFF has no image directory")
    width, height = sizes["ImageWidth"], sizes["ImageLength"]
    strip_rows = sizes.get("RowsPerStrip", 2**32 - 1)
    strip = width * (height if strip_rows == 2**32 - 1 else strip_rows)  # that number: all rows in one strip
    tile = sizes.get("TileWidth", 1) * sizes.get("TileLength", 1)
    if max(strip, tile) > max(_MAX_TILE, width * height):
        raise UnusableImage(f"damaged: the TIFF of {width} x {height} has a part of {max(strip, tile)} pixels")
    extra = values.get(_TIFF_EXTRA, ())
    of_colours = values.get(_TIFF_PHOTOMETRIC, (_TIFF_RGB,))[0] == _TIFF_RGB and sizes.get("SamplesPerPixel", 1) == 4
    alpha = int(extra[0]) if len(extra) == 1 else (_UNASSOCIATED if of_colours and _TIFF_EXTRA not in kinds else 0)
    if extra and alpha == _UNASSOCIATED and sizes.get("BitsPerSample", 8) <= 8:
        decodable = _mark_alpha_associated(data, offset, order)  # libtiff would multiply the colours by alpha
    else:
        decodable = data
    return ImageHeader(
        width,
        height,
        exif=data,
        decodable=decodable,
        bits=max(8, sizes.get("BitsPerSample", 8)),
        has_alpha=alpha in (_ASSOCIATED, _UNASSOCIATED),
        is_premultiplied=alpha == _ASSOCIATED,
        turns_itself=True,
    )


def _mark_alpha_associated(data: bytes, offset: int, order: str) -> bytes:
    """The TIFF whose directory at `offset` says of its one extra sample that colours are multiplied by it already."""
    changed = bytearray(data)
    (entries,) = struct.unpack_from(order + "H", data, offset)
    for entry in range(entries):
        place = offset + 2 + 12 * entry
        if struct.unpack_from(order + "H", data, place)[0] == _TIFF_EXTRA:
            struct.pack_into(order + "HIHH", changed, place + 2, _TIFF_SHORT, 1, _ASSOCIATED, 0)
    return bytes(changed)


_BMP_OLD_SIZE, _BMP_LEAST_SIZE = 12, 36  # bytes of the second header: OS/2 1.x, and what OpenCV reads


def _bmp_header(data: bytes) -> ImageHeader:
    (header_size,) = struct.unpack_from("<I", data, 14)
    if header_size != _BMP_OLD_SIZE and header_size < _BMP_LEAST_SIZE:
        raise UnusableImage(f"damaged: no BMP has a header of {header_size} bytes")
    width, height = struct.unpack_from("<HH" if header_size == _BMP_OLD_SIZE else "<ii", data, 18)
    return ImageHeader(abs(width), abs(height), decodable=data)


_PNM_HEADER = re.compile(rb"(P[2356])" + 3 * rb"(?:[ \t\r\n]+(?:#[^\n]*\n)*)+([0-9]{1,6})" + rb"[ \t\r\n]")


def _pnm_header(data: bytes) -> ImageHeader:
    """PPM and PGM (netpbm): sizes as numbers, then all pixels. The decoder gets a header without remarks."""
    match = _PNM_HEADER.match(data)
    if match is None:
        raise UnusableImage("damaged: a PPM or PGM must begin with its width, its height and its largest value")
    kind, (width, height, most) = match[1], map(int, match.groups()[1:])
    if not 1 <= most <= 65_535:
        raise UnusableImage(f"damaged: the largest value of a PPM or PGM must be 1 to 65535, is {most}")
    bits, pixels = (16 if most > 255 else 8), data[match.end() :]
    samples = width * height * (3 if kind in (b"P3", b"P6") else 1)
    if len(pixels) < (samples * bits // 8 if kind in (b"P5", b"P6") else 2 * samples - 1):
        raise UnusableImage("truncated: the file ends early")
    decodable = b"%s\n%d %d\n%d\n" % (kind, width, height, most) + pixels
    return ImageHeader(width, height, decodable=decodable, bits=bits)


# Bytes of a JPEG 2000 file -> RGB image, or the reason why not.
#
# OpenCV decodes it. What its decoder takes depends on tiles and components that a crafted file may choose, so each
# file is decoded in a process of its own, which has a limit on its memory and its time, and which may end.

SUFFIXES = {".jp2", ".j2k"}
_BOXED, _CODESTREAM, _END = b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51", b"\xff\xd9"
_EXTENT = struct.Struct(">IIII")  # right, lower, left and upper border, behind the first two markers
_SIZE = struct.Struct("<II")  # width and height, before the pixels
_BASE_BYTES = 300_000_000  # of memory for the decoder, whatever the size of an image
_BYTES_A_PIXEL = 64  # further ones: four components of 32 bits, their wavelets, and the image
_DECODING_S = 120  # of processor time at most


def is_jpeg2000(data: bytes) -> bool:
    """Whether the bytes begin as a JP2 file or a bare codestream does (ISO/IEC 15444-1)."""
    return data.startswith((_BOXED, _CODESTREAM))


def check_whole(data: bytes) -> None:
    """Raises UnusableImage where the file does not end as a codestream does: somebody may still be writing it."""
    if not data.rstrip(b"\0").endswith(_END) and _END not in data[-64:]:
        raise UnusableImage("truncated: the JPEG 2000 file has no end-of-codestream marker")


def read_size(data: bytes) -> tuple[int, int]:
    """Width and height, as the codestream's first marker states them. Raises UnusableImage."""
    start = data.find(_CODESTREAM)
    stated = data[start + 8 : start + 8 + _EXTENT.size]
    if start < 0 or len(stated) < _EXTENT.size:
        raise UnusableImage("truncated: the JPEG 2000 file has no codestream")
    right, lower, left, upper = _EXTENT.unpack(stated)
    width, height = right - left, lower - upper
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        raise UnusableImage(f"{width} x {height}: each side must have 1 to {MAX_SIDE} pixels; resize or cut it")
    return width, height


def decode(data: bytes, max_pixels: int) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB, 8 bits a channel, without alpha. Raises UnusableImage."""
    check_whole(data)
    width, height = read_size(data)
    if width * height > max_pixels:
        raise UnusableImage(f"{width} x {height}: more than {max_pixels} pixels; make it smaller")
    wanted = _SIZE.size + 3 * width * height
    answer, code = python.answer("splatnode.capture.image_header", data, wanted, str(width * height))
    if len(answer) < wanted or _SIZE.unpack_from(answer) != (width, height):
        raise UnusableImage(f"damaged, or of an unknown kind: its decoder ended ({code})")
    return np.frombuffer(answer, np.uint8, offset=_SIZE.size).reshape(height, width, 3)


def main() -> None:
    """The decoder's process: PIXELS; the file on standard input, on standard output its size and its pixels."""
    import cv2

    data, pixels = sys.stdin.buffer.read(), int(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_CPU, (_DECODING_S, _DECODING_S))
    python.limit_memory(_BASE_BYTES + _BYTES_A_PIXEL * pixels)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise SystemExit(1)
    height, width = image.shape[:2]
    sys.stdout.buffer.write(_SIZE.pack(width, height) + cv2.cvtColor(image, cv2.COLOR_BGR2RGB).tobytes())


if __name__ == "__main__":
    main()
