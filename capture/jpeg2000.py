"""Bytes of a JPEG 2000 file -> RGB image, or the reason why not.

OpenCV decodes it. What its decoder takes depends on tiles and components that a crafted file may choose, so each file
is decoded in a process of its own, which has a limit on its memory and its time, and which may end.
"""

from __future__ import annotations

import resource
import struct
import sys

import numpy as np
import numpy.typing as npt

from splatnode.capture.image_header import MAX_SIDE, UnusableImage
from splatnode.capture.process import apart

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
    answer, code = apart.answer("splatnode.capture.jpeg2000", data, wanted, str(width * height))
    if len(answer) < wanted or _SIZE.unpack_from(answer) != (width, height):
        raise UnusableImage(f"damaged, or of an unknown kind: its decoder ended ({code})")
    return np.frombuffer(answer, np.uint8, offset=_SIZE.size).reshape(height, width, 3)


def main() -> None:
    """The decoder's process: PIXELS; the file on standard input, on standard output its size and its pixels."""
    import cv2

    data, pixels = sys.stdin.buffer.read(), int(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_CPU, (_DECODING_S, _DECODING_S))
    apart.limit_memory(_BASE_BYTES + _BYTES_A_PIXEL * pixels)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise SystemExit(1)
    height, width = image.shape[:2]
    sys.stdout.buffer.write(_SIZE.pack(width, height) + cv2.cvtColor(image, cv2.COLOR_BGR2RGB).tobytes())


if __name__ == "__main__":
    main()
