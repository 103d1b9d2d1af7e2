"""The depth that a message of an image topic holds: raw, or packed into a PNG as ROS' compressedDepth has it.

Source: ROS' compressed_depth_image_transport. Its files have 12 bytes before the PNG: how depth was packed, and two
numbers a and b. Of 16UC1 the PNG has millimetres, of 32FC1 values v for a depth of a / (v - b) metres.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import MOST_PIXELS
from splatnode.capture.image_file import UnusableImage, decode_values
from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.extras.logged.messages import DEPTH_TYPES, Layout, Picture, UnusableMessage, find_encoding, read_rows

_HEAD = struct.Struct("<iff")  # before the PNG of compressedDepth
_PACKED = "compressedDepth"  # in the format of a file that has such a head
_METRES, _PNG = "32FC1", b"\x89PNG"


def decode_depth(picture: Picture) -> npt.NDArray[np.uint16] | npt.NDArray[np.float32]:
    """(H, W) millimetres, or metres where they are floats; 0, or no finite number, where nothing was measured.

    Raises UnusableMessage.
    """
    encoding = find_encoding(picture)
    if encoding not in DEPTH_TYPES:
        raise UnusableMessage(
            f"a depth image must have an encoding of {' or '.join(DEPTH_TYPES)}, it has "
            f"{sanitize_text(encoding, 40) or 'none'}"
        )
    with guard_untrusted(UnusableMessage, "a depth image"):
        if picture.layout is not None:
            return _decode_rows(picture.data, picture.layout)
        return _decode_file(picture.data, picture.format, encoding)


def _decode_rows(data: bytes, layout: Layout) -> npt.NDArray:
    kind = DEPTH_TYPES[layout.encoding]
    pixels = read_rows(data, layout, kind.itemsize, MOST_PIXELS)
    values = pixels.view(kind.newbyteorder(">" if layout.is_big_endian else "<"))[..., 0]
    return values.astype(kind, copy=False)


def _decode_file(data: bytes, told: str, encoding: str) -> npt.NDArray:
    """Decodes what a sender of this format packed. Raises UnusableMessage."""
    way = told.partition(";")[2]
    if "rvl" in way.lower():
        raise UnusableMessage(
            "depth that was packed by RVL is not read; log the raw topic, or compressedDepth with the format png"
        )
    is_packed = _PACKED in way
    if is_packed and len(data) < _HEAD.size:
        raise UnusableMessage(f"{_PACKED} must have {_HEAD.size} bytes before its PNG, it has {len(data)} in all")
    png = data[_HEAD.size :] if is_packed else data
    if not png.startswith(_PNG):
        raise UnusableMessage(f"a file of depth must be a PNG, it begins with {png[:4].hex() or 'nothing'}")
    try:
        values = decode_values(png, MOST_PIXELS)
    except UnusableImage as error:
        raise UnusableMessage(str(error)) from error
    if values.ndim != 2 or values.dtype != np.uint16:
        raise UnusableMessage(f"a file of depth must be (H, W) of 16 bits, it is {values.shape} {values.dtype}")
    if encoding != _METRES:
        return values
    if not is_packed:
        raise UnusableMessage(f"a file of {_METRES} must be {_PACKED}, it is {sanitize_text(told, 40)}")
    _, a, b = _HEAD.unpack_from(data)
    if not (0 < a < np.inf and abs(b) < np.inf):
        raise UnusableMessage(f"{_PACKED} of {_METRES} must tell how depth was packed, it has a = {a:g} and b = {b:g}")
    with np.errstate(divide="ignore", over="ignore"):
        metres = np.float32(a) / (values.astype(np.float32) - np.float32(b))
    return np.where((values > 0) & np.isfinite(metres), metres, np.float32(0))
