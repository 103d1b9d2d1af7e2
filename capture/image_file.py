"""Bytes of an image file -> upright RGB image and what the file tells about its camera, or the reason why not.

cv2 decodes; before it does, the file's structure is walked here, because cv2 neither reports a JPEG that ends early
(measured: cv2.imread gives a full-size array, grey from there on) nor the size before it allocates the memory.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture import exif
from splatnode.capture.frame import Intrinsics

SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}  # of what can be decoded
MAX_PIXELS = 100_000_000  # of an image, unless another limit is given


class UnusableImage(Exception):
    """The bytes hold no image that can be used; the message says why."""


@dataclass(frozen=True)
class ImageHeader:
    width: int  # as stored, before the EXIF orientation is applied
    height: int
    exif: bytes = b""  # a TIFF structure


def decode_image(data: bytes, max_pixels: int = MAX_PIXELS) -> tuple[npt.NDArray[np.uint8], Intrinsics | None]:
    """The image (H, W, 3) uint8 RGB, upright after its EXIF orientation, with the intrinsics that its EXIF tells.

    Grey becomes RGB, 16 bits become the upper 8, and alpha is dropped: the colours beneath it are kept as stored, as
    COLMAP does. Of a file with several pages, the first. Raises UnusableImage.
    """
    header = read_header(data)
    if header.width * header.height > max_pixels:
        raise UnusableImage(f"{header.width} x {header.height}: more than {max_pixels} pixels; make it smaller")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise UnusableImage(f"damaged: {error.err}") from error
    if image is None:
        raise UnusableImage("damaged: its pixels cannot be decoded")
    height, width = image.shape[:2]
    intrinsics = exif.exif_intrinsics(exif.read_tags(header.exif), width, height)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False), intrinsics


def encode_png(image: npt.NDArray[np.uint8]) -> bytes:
    """An image (H, W, 3) RGB as a PNG file."""
    _, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return png.tobytes()


def read_header(data: bytes) -> ImageHeader:
    """Size and EXIF of a JPEG, PNG, WebP, TIFF or BMP file that is structurally complete. Raises UnusableImage."""
    if not data:
        raise UnusableImage("empty file")
    readers: dict[bytes, Callable[[bytes], ImageHeader]] = {
        b"\xff\xd8\xff": _jpeg_header,
        b"\x89PNG\r\n\x1a\n": _png_header,
        b"RIFF": _webp_header,
        b"II*\0": _tiff_header,
        b"MM\0*": _tiff_header,
        b"BM": _bmp_header,
    }
    for magic, reader in readers.items():
        if data.startswith(magic):
            try:
                return reader(data)
            except struct.error as error:  # the structure points beyond the end
                raise UnusableImage("truncated: the file ends early") from error
    raise UnusableImage(f"not an image: no JPEG, PNG, WebP, TIFF or BMP begins with {data[:4].hex(' ')}")


_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xd0-\xd7\xff])")  # in entropy-coded data, FF 00 and FF D0..D7 are no markers
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # start of frame: every coding process
_JPEG_SCAN, _JPEG_END, _JPEG_APP1 = 0xDA, 0xD9, 0xE1


def _jpeg_header(data: bytes) -> ImageHeader:
    """Walks all segments to the end-of-image marker (ITU-T T.81, annex B), which a truncated file lacks."""
    size, tiff, position = None, b"", 2
    while match := _JPEG_MARKER.search(data, position):
        marker = match.group(1)[0]
        if marker == _JPEG_END:
            if size is None:
                raise UnusableImage("damaged: a JPEG without an image")
            return ImageHeader(*size, exif=tiff)
        (length,) = struct.unpack_from(">H", data, match.end())
        segment = data[match.end() + 2 : match.end() + length]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", segment, 1)
            size = width, height
        elif marker == _JPEG_APP1 and segment.startswith(b"Exif\0\0"):
            tiff = segment[6:]
        position = match.end() + length
    raise UnusableImage("truncated: the JPEG has no end-of-image marker")


def _png_header(data: bytes) -> ImageHeader:
    tiff, position = b"", 8
    width, height = struct.unpack_from(">II", data, 16)
    while True:
        length, kind = struct.unpack_from(">I4s", data, position)
        if kind == b"IEND":
            return ImageHeader(width, height, tiff)
        if kind == b"eXIf":
            tiff = data[position + 8 : position + 8 + length]
        position += 12 + length


def _webp_header(data: bytes) -> ImageHeader:
    """RIFF chunks (RFC 9649): the size is in VP8X, or in the only VP8 or VP8L chunk."""
    riff_size, form = struct.unpack_from("<I4s", data, 4)
    if form != b"WEBP":
        raise UnusableImage("not an image: a RIFF file that is not WebP")
    if riff_size + 8 > len(data):
        raise UnusableImage("truncated: the file ends early")
    size, tiff, position = None, b"", 12
    while position + 8 <= riff_size + 8:
        kind, length = struct.unpack_from("<4sI", data, position)
        body = data[position + 8 : position + 8 + length]
        if kind == b"EXIF":
            tiff = body.removeprefix(b"Exif\0\0")
        elif size is None and kind == b"VP8X":
            size = tuple(1 + int.from_bytes(body[start : start + 3], "little") for start in (4, 7))
        elif size is None and kind == b"VP8L":
            bits = int.from_bytes(body[1:5], "little")
            size = 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
        elif size is None and kind == b"VP8 ":
            size = tuple(value & 0x3FFF for value in struct.unpack_from("<HH", body, 6))
        position += 8 + length + length % 2
    if size is None:
        raise UnusableImage("damaged: a WebP without an image")
    return ImageHeader(*size, exif=tiff)


def _tiff_header(data: bytes) -> ImageHeader:
    tags = exif.read_tags(data)
    width, height = exif.first(tags, exif.IMAGE_WIDTH), exif.first(tags, exif.IMAGE_LENGTH)
    if width is None or height is None:
        raise UnusableImage("truncated: the TIFF has no image directory")
    return ImageHeader(int(width), int(height), exif=data)


def _bmp_header(data: bytes) -> ImageHeader:
    width, height = struct.unpack_from("<ii", data, 18)
    return ImageHeader(abs(width), abs(height))
