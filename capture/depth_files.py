"""Depth images in files: PNG and TIFF of 16 bits, NumPy's, and OpenEXR as telephones write it."""

from __future__ import annotations

import io
import logging
import math
import struct
import zlib
from collections.abc import Iterable
from os import fspath
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import MOST_PIXELS, DepthImage, DepthNoise, make_depth_image
from splatnode.capture.frame import LARGEST_SIDE, Intrinsics
from splatnode.capture.image_file import UnusableImage, decode_values, read_image_file
from splatnode.capture.process.library_lines import ignore_file_warnings
from splatnode.capture.process.terminal import notify
from splatnode.capture.process.text import guard_untrusted, sanitize_text

log = logging.getLogger(__name__)

_LEAST_PAIRED = 0.5  # share of the photographs with a depth image
SUFFIXES = {".png", ".tif", ".tiff", ".npy", ".exr"}

# Of OpenEXR: single-part files of scan lines, not compressed or by zlib, as Record3D and OpenCV write them.
_EXR = b"\x76\x2f\x31\x01"
_LINES = {0: 1, 2: 1, 3: 16}  # of a block by its compression: none, ZIPS, ZIP
_TYPES = {1: np.dtype("<f2"), 2: np.dtype("<f4")}  # of a channel
_MOST_ATTRIBUTES, _MOST_CHANNELS = 200, 32
_MOST_EXR_BYTES = 16 * MOST_PIXELS  # of all its lines and channels, unpacked
_MOST_HEADER = 1000  # bytes of an array's header in .npy


def find_depth_files(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """The files of a folder that have the names of these photographs, whatever their suffixes. Few are notified.

    Raises FileNotFoundError, and ValueError where there is none.
    """
    names = list(names)
    if not folder.is_dir():
        raise FileNotFoundError(f"{fspath(folder)!r} is not there; give a folder of depth images")
    files = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in SUFFIXES}
    found = {name: files[Path(name).stem] for name in names if Path(name).stem in files}
    if not found:
        raise ValueError(f"no depth image in {fspath(folder)!r} has the name of a photograph; name both alike")
    if told := describe_few_pairs(len(found), len(names)):
        notify(log, told)
    return found


def is_few(num_found: int, num_photographs: int) -> bool:
    """Whether so few photographs have a depth image that people should know."""
    return num_found < _LEAST_PAIRED * num_photographs


def describe_few_pairs(num_found: int, num_photographs: int) -> str:
    """How many photographs have a depth image of their name, where these are few; else empty."""
    if not is_few(num_found, num_photographs):
        return ""
    return (
        f"{num_found} of {num_photographs} photographs have a depth image: those of other names count for none. Name "
        "both alike"
    )


def read_depth_file(
    path: Path,
    unit_m: float | None = None,
    intrinsics: Intrinsics | None = None,
    noise: DepthNoise | str = "stereo",
) -> DepthImage:
    """The depth image in a file: whole numbers are millimetres, floats metres, unless `unit_m` tells.

    Raises UnusableImage, OSError.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UnusableImage(
            f"{sanitize_text(path.suffix)} is no suffix of depth images; convert to PNG of 16 bits (millimetres), "
            "or .npy or .exr of metres"
        )
    data = read_image_file(path, MOST_PIXELS)
    with guard_untrusted(UnusableImage, "a depth image"):
        try:
            return make_depth_image(_decode(data), unit_m, intrinsics, noise=noise)
        except ValueError as error:
            raise UnusableImage(str(error)) from error


def _decode(data: bytes) -> npt.NDArray:
    if data.startswith(_EXR):
        return decode_exr(data)
    if data.startswith(b"\x93NUMPY"):
        return _decode_npy(data)
    return decode_values(data, MOST_PIXELS)


def _decode_npy(data: bytes) -> npt.NDArray:
    """The one array of numbers of a file; nothing is unpickled, and no memory is taken that the file does not fill."""
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
        with ignore_file_warnings():
            shape, by_columns, dtype = read(file, max_header_size=_MOST_HEADER)
    except (ValueError, OSError, MemoryError, RecursionError) as error:  # of a header that Python parses: its own fault
        raise UnusableImage(f"no array of NumPy: {sanitize_text(error, 300)}") from None
    if dtype.kind not in "fu" or len(shape) > 3 or min(shape, default=0) < 0:
        raise UnusableImage(f"no array (H, W) of numbers: {shape} {dtype}")
    count = math.prod(shape)
    if count * dtype.itemsize > len(data) - file.tell():
        raise UnusableImage("truncated: the file ends early")
    flat = np.frombuffer(data, dtype, count, file.tell())
    return flat.reshape(shape, order="F" if by_columns else "C")


def decode_exr(data: bytes) -> npt.NDArray[np.float32]:
    """(H, W) the depth of an OpenEXR file: its channel Z, Y or R, else its only one. Raises UnusableImage."""
    try:
        attributes, position = _read_attributes(data)
        channels = _read_channels(attributes["channels"])
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
        compression = attributes["compression"][0]
    except (KeyError, IndexError, ValueError, struct.error) as error:
        raise UnusableImage(f"damaged, or no OpenEXR file of one part: {error}") from error
    width, height = right - left + 1, bottom - top + 1
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE and width * height <= MOST_PIXELS):
        raise UnusableImage(f"{width} x {height}: a depth image must have 1 to {MOST_PIXELS} pixels")
    if compression not in _LINES:
        raise UnusableImage("an OpenEXR file must be compressed by ZIP, ZIPS or not at all; convert it")
    wanted = next((name for name in ("Z", "Y", "R") if name in channels), None)
    wanted = next(iter(channels)) if wanted is None and len(channels) == 1 else wanted
    if wanted is None:
        raise UnusableImage(f"an OpenEXR depth image must have a channel Z, Y or R; it has {len(channels)} others")
    return _read_lines(data, position, (height, width), channels, wanted, compression)


def _read_attributes(data: bytes) -> tuple[dict[str, bytes], int]:
    """The attributes of the header by name, and where it ends."""
    (flags,) = struct.unpack_from("<i", data, 4)
    if flags & 0x1A00:
        raise ValueError("it has tiles, deep pixels or several parts")
    position, found = 8, dict[str, bytes]()
    while data[position : position + 1] != b"\0":
        name_end = data.index(b"\0", position, position + 256)
        kind_end = data.index(b"\0", name_end + 1, name_end + 257)
        (size,) = struct.unpack_from("<i", data, kind_end + 1)
        if not 0 <= size <= len(data) or len(found) >= _MOST_ATTRIBUTES:
            raise ValueError("an attribute is too large")
        found[data[position:name_end].decode("latin-1")] = data[kind_end + 5 : kind_end + 5 + size]
        position = kind_end + 5 + size
    return found, position + 1


def _read_channels(data: bytes) -> dict[str, np.dtype]:
    """The type of each channel by name, in the order in which they are stored."""
    position, found = 0, dict[str, np.dtype]()
    while data[position] != 0:
        end = data.index(b"\0", position)
        kind, across, down = (struct.unpack_from("<i", data, end + 1 + offset)[0] for offset in (0, 8, 12))
        if kind not in _TYPES or (across, down) != (1, 1) or len(found) >= _MOST_CHANNELS:
            raise ValueError("a channel that is no float of every pixel")
        found[data[position:end].decode("latin-1")] = _TYPES[kind]
        position = end + 17
    return found


def _read_lines(
    data: bytes, position: int, shape: tuple[int, int], channels: dict[str, np.dtype], wanted: str, compression: int
) -> npt.NDArray[np.float32]:
    height, width = shape
    lines = _LINES[compression]
    count = -(-height // lines)
    offsets = struct.unpack_from(f"<{count}Q", data, position) if 8 * count <= len(data) - position else ()
    if len(offsets) != count:
        raise UnusableImage("truncated: the file ends early")
    line_bytes = sum(kind.itemsize for kind in channels.values()) * width
    if line_bytes * height > _MOST_EXR_BYTES:
        raise UnusableImage(f"{width} x {height} of {len(channels)} channels: too large; write the depth channel alone")
    before = 0
    for name, kind in channels.items():
        if name == wanted:
            break
        before += kind.itemsize * width
    made, read_bytes = np.zeros(shape, np.float32), 0
    for block, offset in enumerate(offsets):
        if not position <= offset <= len(data) - 8:
            raise UnusableImage("truncated: the file ends early")
        (size,) = struct.unpack_from("<i", data, offset + 4)
        rows = min(lines, height - block * lines)
        read_bytes += 8 + max(0, size)
        if read_bytes > len(data) or size > rows * line_bytes:  # who packs leaves as it is what would grow
            raise UnusableImage("damaged: its blocks overlap, or are larger than what they hold")
        raw = _inflate(data[offset + 8 : offset + 8 + max(0, size)], rows * line_bytes, compression)
        table = np.frombuffer(raw, np.uint8).reshape(rows, line_bytes)
        kind = channels[wanted]
        own = np.ascontiguousarray(table[:, before : before + kind.itemsize * width]).view(kind)
        made[block * lines : block * lines + rows] = own
    return made


def _inflate(data: bytes, size: int, compression: int) -> bytes:
    """The bytes of a block; a compressed one is predicted from its neighbours, and its halves are interleaved."""
    if compression == 0 or len(data) == size:
        raw = data
    else:
        stream = zlib.decompressobj()
        try:
            raw = stream.decompress(data, size)
        except zlib.error as error:
            raise UnusableImage(f"damaged: {error}") from error
        steps = np.frombuffer(raw, np.uint8).copy()
        steps[1:] += 128  # modulo 256, as the sums below
        flat = np.cumsum(steps, dtype=np.uint8)
        woven = np.empty_like(flat)
        half = (len(flat) + 1) // 2
        woven[::2], woven[1::2] = flat[:half], flat[half:]
        raw = woven.tobytes()
    if len(raw) != size:
        raise UnusableImage("truncated: the file ends early")
    return raw
