"""Bytes of an image file -> upright RGB image and what the file tells about its camera, or the reason why not.

cv2 decodes; before it does, the file's structure is walked (image_header.py), because cv2 neither reports a JPEG that
ends early (measured: cv2.imread gives a full-size array, grey from there on) nor the size
before it allocates the memory.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import exif, heif_file
from splatnode.capture.exif_time import exif_time
from splatnode.capture.exposure_settings import ExposureSettings
from splatnode.capture.frame import Intrinsics
from splatnode.capture.image_header import UnusableImage, read_header
from splatnode.capture.orientation import ON_ITS_SIDE, ORIENTATION
from splatnode.capture.process.bounded_file import read_bounded
from splatnode.capture.process.foreign import foreign
from splatnode.capture.stamp import Stamp

# Of what can be decoded, HEIC and AVIF with the extra heic.
SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", *heif_file.SUFFIXES}
MAX_PIXELS = 100_000_000  # of an image, unless another limit is given
MaxPixels = Annotated[int, msgspec.Meta(ge=1, le=1 << 30)]  # of a configuration; OpenCV decodes no more
BYTES_A_PIXEL = 16  # of memory at most beside the file itself, until an image is decoded; afterwards it has 3
_FILE_BYTES_A_PIXEL = 8  # 16 bits, four channels, not compressed
_FURTHER_FILE_BYTES = 64_000_000  # what a telephone puts behind a photograph: a film, a depth map


class DecodedImage(NamedTuple):
    """An image, and what its EXIF tells: of the camera, when it was taken, and how it was exposed."""

    image: npt.NDArray[np.uint8]  # (H, W, 3) RGB, upright
    intrinsics: Intrinsics | None
    captured_at: Stamp | None
    exposure: ExposureSettings | None


def read_image_file(path: Path, max_pixels: int = MAX_PIXELS) -> bytes:
    """The file's bytes for `decode_image`, if an image of `max_pixels` may have so many.

    Raises UnusableImage, OSError.
    """
    return read_bounded(path, _FILE_BYTES_A_PIXEL * max_pixels + _FURTHER_FILE_BYTES, UnusableImage)


def decode_photograph(data: bytes, max_pixels: int = MAX_PIXELS) -> DecodedImage:
    """As `decode_image`, of a file that a person put there: HEIC and AVIF are decoded, too, in a process of their own.

    What another process sent goes to `decode_image`. Raises UnusableImage.
    """
    if not heif_file.is_heif(data):
        return decode_image(data, max_pixels)
    image, tiff = heif_file.decode(data, max_pixels)
    return _with_exif(image, tiff)


def check_whole(data: bytes) -> None:
    """Raises UnusableImage where an image file is not complete, or is none."""
    if heif_file.is_heif(data):
        heif_file.check_whole(data)
    else:
        read_header(data)


def upright_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that an image file is decoded to; None where only decoding it tells. Raises UnusableImage."""
    if heif_file.is_heif(data):
        return None
    header = read_header(data)
    turned = (exif.first(exif.read_tags(header.exif), ORIENTATION) or 1) in ON_ITS_SIDE
    return (header.height, header.width) if turned else (header.width, header.height)


def decode_image(data: bytes, max_pixels: int = MAX_PIXELS) -> DecodedImage:
    """The image (H, W, 3) uint8 RGB, upright after its EXIF orientation, with what its EXIF tells.

    Grey becomes RGB, 16 bits become the upper 8, and alpha is dropped: the colours beneath it are kept as stored, as
    COLMAP does. Of a file with several pages, the first. It takes at most BYTES_A_PIXEL of memory for each of
    `max_pixels`, whatever the file says. Raises UnusableImage.
    """
    with foreign(UnusableImage):
        header = read_header(data)
        if header.width * header.height > max_pixels:
            raise UnusableImage(f"{header.width} x {header.height}: more than {max_pixels} pixels; make it smaller")
        image = _decode(header.decodable)
        height, width = image.shape[:2]
        if sorted((width, height)) != sorted((header.width, header.height)):
            stated = f"{header.width} x {header.height}"
            raise UnusableImage(f"damaged: it states {stated} pixels and is decoded to {width} x {height}")
        return _with_exif(cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False), header.exif)


def _with_exif(image: npt.NDArray[np.uint8], tiff: bytes) -> DecodedImage:
    """The image (H, W, 3) RGB with what its EXIF tells, whose bytes begin with a TIFF header."""
    tags = exif.read_tags(tiff)
    intrinsics = exif.exif_intrinsics(tags, image.shape[1], image.shape[0])
    return DecodedImage(image, intrinsics, exif_time(tiff), exif.exif_exposure(tags))


def _decode(data: bytes) -> npt.NDArray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise UnusableImage(f"damaged: {error.err}") from error
    if image is None:
        raise UnusableImage("damaged: its pixels cannot be decoded")
    return image


def encode_jpeg(image: npt.NDArray[np.uint8], quality: int) -> bytes:
    """An image (H, W, 3) RGB as a JPEG file; `quality` is 1 to 100."""
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return jpeg.tobytes()


def encode_png(image: npt.NDArray[np.uint8]) -> bytes:
    """An image (H, W, 3) RGB as a PNG file."""
    _, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return png.tobytes()
