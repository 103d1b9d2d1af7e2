"""Bytes of an image file -> upright RGB image and what the file tells about its camera, or the reason why not.

cv2 decodes; before it does, the file's structure is walked (image_header.py), because cv2 neither reports a JPEG that
ends early (measured: cv2.imread gives a full-size array, grey from there on) nor the size
before it allocates the memory.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import struct
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import image_header
from splatnode.capture.frame import ExposureSettings, Intrinsics, Stamp
from splatnode.capture.image_header import MAX_SIDE, ImageHeader, UnusableImage, exif_time, read_header
from splatnode.capture.pi_heif import HEADER
from splatnode.capture.process import python
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.library_lines import catch_library_lines
from splatnode.capture.process.system import outlast, remedy
from splatnode.capture.process.text import guard_untrusted

# Bytes of a HEIC or AVIF file -> upright RGB image and its EXIF, or the reason why not.
#
# Their decoders have had many faults that a crafted file uses. So each file is decoded in a process of its own, which
# has a limit on its memory and its time, and which may end.

HEIF_SUFFIXES = {".heic", ".heif", ".hif", ".avif"}
_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"mif1", b"mif2", b"miaf", b"avif"}  # of still images
_MOST_EXIF = 10_000_000  # bytes
_MOST_BOXES = 1000  # at the top level of a file


class HeifImage(NamedTuple):
    image: npt.NDArray[np.uint8]  # (H, W, 3) RGB, upright
    exif: bytes  # a TIFF structure; empty where there is none


def is_heif(data: bytes) -> bool:
    """Whether the bytes begin as a HEIC or AVIF file does (ISO/IEC 23008-12): its first box names one of the brands."""
    if data[4:8] != b"ftyp":
        return False
    first = data[8 : min(int.from_bytes(data[:4], "big"), 1024)]
    return first[:4] in _BRANDS or any(first[i : i + 4] in _BRANDS for i in range(8, len(first), 4))


def advise_heif_installation() -> str | None:
    """Says what to install before such a file can be decoded; None where nothing is missing."""
    there = all(importlib.util.find_spec(package) for package in ("pi_heif", "PIL"))
    return None if there else f"{remedy('pi_heif')}, or convert it to JPEG"


def check_whole_heif(data: bytes) -> None:
    """Raises UnusableImage where the file ends within one of its boxes: somebody may still be writing it."""
    position = 0
    for _ in range(_MOST_BOXES):
        if position == len(data):
            return
        try:
            length, _kind = struct.unpack_from(">I4s", data, position)
            if length == 1:
                (length,) = struct.unpack_from(">Q", data, position + 8)
        except struct.error:
            break
        if length == 0:  # up to the end of the file, wherever that is
            return
        if length < 8 or position + length > len(data):
            break
        position += length
    raise UnusableImage("truncated: the file ends early")


def decode_heif(data: bytes, max_pixels: int) -> HeifImage:
    """The file's primary image, 8 bits a channel, without alpha. Raises UnusableImage."""
    if (needed := advise_heif_installation()) is not None:
        raise UnusableImage(f"HEIC and AVIF need a further package. {needed}")
    check_whole_heif(data)
    command = python.command("splatnode.capture.pi_heif", str(max_pixels))
    with python.start_process(command, subprocess.PIPE) as child:
        return _receive_image(child, data, max_pixels)


def _receive_image(child: subprocess.Popen[bytes], data: bytes, max_pixels: int) -> HeifImage:
    assert child.stdin is not None and child.stdout is not None
    try:
        child.stdin.write(data)  # it reads all before it writes anything
        child.stdin.close()
    except BrokenPipeError:
        raise UnusableImage("its decoder ended before it had read the file") from None
    head = child.stdout.read(HEADER.size)
    if len(head) < HEADER.size:
        raise UnusableImage(f"damaged, or of an unknown kind: its decoder ended ({child.wait()})")
    width, height, exif_bytes = HEADER.unpack(head)
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        raise UnusableImage(f"{width} x {height}: each side must have 1 to {MAX_SIDE} pixels; resize or cut it")
    if width * height > max_pixels:
        raise UnusableImage(f"{width} x {height}: more than {max_pixels} pixels; make it smaller")
    if exif_bytes > _MOST_EXIF:
        raise UnusableImage(f"damaged: its EXIF has {exif_bytes} bytes; at most {_MOST_EXIF} are read")
    exif, pixels = child.stdout.read(exif_bytes), child.stdout.read(width * height * 3)
    if len(pixels) < width * height * 3:
        raise UnusableImage(f"damaged: its decoder ended ({child.wait()}) within the pixels")
    return HeifImage(np.frombuffer(pixels, np.uint8).reshape(height, width, 3), exif.removeprefix(b"Exif\0\0"))


# How a photograph was turned when it was taken, as EXIF tells, undone.

ORIENTATION = 0x0112  # of EXIF
# By what EXIF says, quarters of a turn to the left, and whether it is mirrored then.
_TURNS = {
    1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (3, True), 6: (3, False), 7: (1, True), 8: (1, False),
}  # fmt: skip
ON_ITS_SIDE = tuple(orientation for orientation, (quarters, _) in _TURNS.items() if quarters % 2)


def upright(image: npt.NDArray, orientation: int) -> npt.NDArray:
    """The image (H, W) or (H, W, C) turned as EXIF says; `orientation` is 1 to 8."""
    quarters, mirrored = _TURNS.get(orientation, _TURNS[1])
    turned = np.rot90(image, quarters)
    return turned[:, ::-1] if mirrored else turned


# Images of 16 bits a channel: which of their values are used, and how these become 8 bits, alike for all of a set.
#
# A sensor of 10, 12 or 14 bits fills the lower bits of 16, a thermal camera a narrow band of them. The upper 8 bits of
# such images are nearly black, so the used range is stretched. It is one range for all images of a set: their
# brightness stays comparable.

Deep = npt.NDArray[np.uint16]

FULL = 65_535
MAX_STRETCHED_BITS = 14  # with 15 or 16 used bits, the upper 8 serve
MAX_BAND = 1 << MAX_STRETCHED_BITS  # width of a band of values that is stretched
MIN_BAND_RATIO = 0.25  # darkest over brightest value, from which on the values lie in a band; else they begin at 0
BAND_MARGIN = 0.05  # of a band's width, on both sides
_OUTLIERS_PERCENT = 0.01  # of the values at both ends: dead and hot pixels
_MAX_SAMPLES = 1_000_000  # values of an image that are looked at


@dataclass(frozen=True)
class Extent:
    """The darkest and the brightest value of images, without outliers."""

    low: int
    high: int


@dataclass(frozen=True)
class ValueRange:
    """The values that become 0 and 255."""

    low: int
    high: int

    def __str__(self) -> str:
        if self.low == 0:
            return f"{self.high.bit_length()} of 16 bits"
        return f"the values {self.low} to {self.high} of 16 bits"


def measure_extent(values: Deep) -> Extent:
    """Measures the extent of the values of an image (H, W) or (H, W, C)."""
    step = max(1, round((values.size / _MAX_SAMPLES) ** 0.5))
    some = values[::step, ::step]
    low, high = np.percentile(some, [_OUTLIERS_PERCENT, 100 - _OUTLIERS_PERCENT], method="nearest")
    return Extent(int(low), int(high))


def find_range(extents: Iterable[Extent]) -> ValueRange | None:
    """Finds the range that images of these extents share; None without images, or where the upper 8 bits show it."""
    known = list(extents)
    if not known:
        return None
    low, high = min(extent.low for extent in known), max(extent.high for extent in known)
    if low >= MIN_BAND_RATIO * high and 0 < high - low < MAX_BAND:
        margin = round(BAND_MARGIN * (high - low)) + 1
        return ValueRange(max(0, low - margin), min(FULL, high + margin))
    bits = max(8, high.bit_length())
    return ValueRange(0, (1 << bits) - 1) if bits <= MAX_STRETCHED_BITS else None


def convert_to_eight_bits(values: Deep, used: ValueRange | None) -> npt.NDArray[np.uint8]:
    """The image with `used` stretched to 0 to 255; None: the upper 8 bits."""
    if used is None:
        return (values >> 8).astype(np.uint8)
    level = np.clip((np.arange(FULL + 1) - used.low) / (used.high - used.low), 0.0, 1.0)
    return np.floor(255.999 * level).astype(np.uint8)[values]


# Of what can be decoded, HEIC and AVIF with the extra heic.
_JPEG_SUFFIXES = {".jpg", ".jpeg", ".jpe", ".jfif", ".jif", ".mpo"}
_MAYBE_DEEP_SUFFIXES = {".png", ".tif", ".tiff", ".ppm", ".pgm", ".pnm"}  # which may have 16 bits a channel
SUFFIXES = {
    *_JPEG_SUFFIXES,
    *_MAYBE_DEEP_SUFFIXES,
    ".bmp",
    ".dib",
    ".webp",
    *image_header.SUFFIXES,
    *HEIF_SUFFIXES,
}
_MAX_MEASURED = 30  # files of a set whose values are looked at before the first is decoded
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
    mask: npt.NDArray[np.bool_] | None = None  # (H, W), False where alpha is 0; None: it hides nothing
    camera: str = ""  # its identity, as `exif.camera_identity` has it


def read_image_file(path: Path, max_pixels: int = MAX_PIXELS) -> bytes:
    """The file's bytes for `decode_image`, if an image of `max_pixels` may have so many.

    Raises UnusableImage, OSError.
    """
    return read_bounded(path, _FILE_BYTES_A_PIXEL * max_pixels + _FURTHER_FILE_BYTES, UnusableImage)


def decode_any_image(data: bytes, max_pixels: int = MAX_PIXELS, used: ValueRange | None = None) -> DecodedImage:
    """As `decode_image`, of a file that a person put there: HEIC, AVIF and JPEG 2000, too, in a process of their own.

    What another process sent goes to `decode_image`. Raises UnusableImage.
    """
    if is_heif(data):
        return _attach_exif(*decode_heif(data, max_pixels))
    if image_header.is_jpeg2000(data):
        return _attach_exif(image_header.decode(data, max_pixels), b"")
    return decode_image(data, max_pixels, used)


def check_whole(data: bytes) -> None:
    """Raises UnusableImage where an image file is not complete, or is none."""
    if is_heif(data):
        check_whole_heif(data)
    elif image_header.is_jpeg2000(data):
        image_header.check_whole(data)
    else:
        read_header(data)


def upright_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that an image file is decoded to; None where only decoding it tells. Raises UnusableImage."""
    if is_heif(data) or image_header.is_jpeg2000(data):
        return None
    header = read_header(data)
    turned = (image_header.first(image_header.read_tags(header.exif), ORIENTATION) or 1) in ON_ITS_SIDE
    return (header.height, header.width) if turned else (header.width, header.height)


def decode_image(data: bytes, max_pixels: int = MAX_PIXELS, used: ValueRange | None = None) -> DecodedImage:
    """The image (H, W, 3) uint8 RGB, upright after its EXIF orientation, with what its EXIF tells.

    Grey becomes RGB. Of 16 bits, the range `used` becomes 8, without it the upper 8. Alpha becomes a mask: the colours
    beneath it are kept as stored. Of a file with several pages, the first. It takes at most BYTES_A_PIXEL of memory for
    each of `max_pixels`, whatever the file says. Raises UnusableImage.
    """
    with guard_untrusted(UnusableImage):
        header = read_header(data)
        if header.width * header.height > max_pixels:
            raise UnusableImage(f"{header.width} x {header.height}: more than {max_pixels} pixels; make it smaller")
        mask = _decode_alpha(header) if header.has_alpha else None
        image = _decode(header, used)
        height, width = image.shape[:2]
        if sorted((width, height)) != sorted((header.width, header.height)):
            stated = f"{header.width} x {header.height}"
            raise UnusableImage(f"damaged: it states {stated} pixels and is decoded to {width} x {height}")
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        return _attach_exif(image, header.exif)._replace(mask=mask)


def decode_values(data: bytes, max_pixels: int = MAX_PIXELS) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """(H, W) or (H, W, C) the values that a file stores, of 8 or 16 bits, as of a depth image: nothing is turned.

    Raises UnusableImage.
    """
    with guard_untrusted(UnusableImage):
        header = read_header(data)
        if header.width * header.height > max_pixels:
            raise UnusableImage(f"{header.width} x {header.height}: more than {max_pixels} pixels; make it smaller")
        values = _decode_as(header, cv2.IMREAD_UNCHANGED)
        if values.shape[:2] != (header.height, header.width):
            raise UnusableImage(f"damaged: it states {header.width} x {header.height} pixels, and has {values.shape}")
        return values


def measure_values(data: bytes, max_pixels: int = MAX_PIXELS) -> Extent | None:
    """The extent of the values of an image file of 16 bits; None of another one, or one that cannot be decoded."""
    try:
        with guard_untrusted(UnusableImage):
            header = read_header(data)
            if header.bits <= 8 or header.width * header.height > max_pixels:
                return None
            return measure_extent(_decode_as(header, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH))
    except UnusableImage:
        return None


def find_common_range(paths: Sequence[Path], max_pixels: int = MAX_PIXELS) -> ValueRange | None:
    """Finds the value range that the 16-bit images among these files share; None where the upper 8 bits show it.

    Of many files, evenly spread ones are looked at. What cannot be read says nothing.
    """
    deep = [path for path in paths if path.suffix.lower() in _MAYBE_DEEP_SUFFIXES]
    extents = []
    for path in deep[:: math.ceil(len(deep) / _MAX_MEASURED) or 1]:
        with contextlib.suppress(OSError, UnusableImage):
            extents.append(outlast(lambda path=path: _measure_file(path, max_pixels), path.name))
    return find_range(extent for extent in extents if extent is not None)


def _measure_file(path: Path, max_pixels: int) -> Extent | None:
    """Raises UnusableImage, OSError."""
    return measure_values(read_image_file(path, max_pixels), max_pixels)


def _attach_exif(image: npt.NDArray[np.uint8], tiff: bytes) -> DecodedImage:
    """The image (H, W, 3) RGB with what its EXIF tells, whose bytes begin with a TIFF header."""
    tags = image_header.read_tags(tiff)
    intrinsics = image_header.exif_intrinsics(tags, image.shape[1], image.shape[0])
    known = exif_time(tiff), image_header.exif_exposure(tags)
    return DecodedImage(image, intrinsics, *known, camera=image_header.camera_identity(tiff))


def _decode(header: ImageHeader, used: ValueRange | None) -> npt.NDArray[np.uint8]:
    """(H, W, 3) BGR, upright."""
    if header.bits <= 8 or used is None:
        return np.asarray(_decode_as(header, cv2.IMREAD_COLOR), np.uint8)
    deep = _decode_as(header, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    return convert_to_eight_bits(deep, used) if deep.dtype == np.uint16 else np.asarray(deep, np.uint8)


def _decode_alpha(header: ImageHeader) -> npt.NDArray[np.bool_] | None:
    """(H, W) upright, where alpha is above 0; None where that is everywhere, or nowhere: such a channel says nothing.

    Where colours are stored multiplied by alpha, those that it dims are hidden, too.
    """
    image = _decode_as(header, cv2.IMREAD_UNCHANGED)
    if image.ndim != 3 or image.shape[2] != 4:
        return None
    alpha = image[..., 3]
    mask = alpha == np.iinfo(alpha.dtype).max if header.is_premultiplied else alpha > 0
    if mask.all() or not mask.any():
        return None
    orientation = (
        1 if header.turns_itself else int(image_header.first(image_header.read_tags(header.exif), ORIENTATION) or 1)
    )
    return np.ascontiguousarray(upright(mask, orientation))


def _decode_as(header: ImageHeader, flags: int) -> npt.NDArray:
    try:
        with catch_library_lines():
            image = cv2.imdecode(np.frombuffer(header.decodable, np.uint8), flags)
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
