"""DepthImage: what a depth camera measured at the moment of a frame, with its lens, its place and its noise."""

from __future__ import annotations

import io
import logging
import math
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from os import fspath
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import LARGEST_SIDE, Intrinsics, rigid_problem
from splatnode.capture.image_file import UnusableImage, decode_values, read_image_file
from splatnode.capture.process.library_lines import ignore_file_warnings
from splatnode.capture.process.terminal import notify
from splatnode.capture.process.text import guard_untrusted, sanitize_text

MOST_PIXELS = 1 << 25  # of a depth image: 33 million
FARTHEST_M = 1000.0  # what is farther was not measured by any depth camera
MILLIMETRE = 0.001  # metres: the unit of most images of 16 bits
ALIGNED = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
NEAREST_M = 0.05  # of a median: what is nearer no depth camera measures, and the unit is another one
USUAL_FARTHEST_M = 100.0  # of a median: what is farther is rare, and probably has another unit
LEAST_KNOWN = 1000  # pixels with a depth, of which values are judged
_MOST_METRES = 20  # of a median: up to here, whole numbers are metres as rooms have them
_LEAST_DISTINCT = 20  # values of whole numbers in an image: of fewer it is probably no depth in millimetres
_UNITS_M = (1e-6, 1.0)  # of a step of 16 bits
_MOST_SIGMA = 1.0  # of each term of the noise: beyond, nothing was measured
_LEAST_SIGMA = 1e-9  # metres, or per metre: what is below makes weights overflow
_LARGEST_OFFSET_M = 10.0  # between a camera and the depth camera beside it


@dataclass(frozen=True)
class DepthNoise:
    """Standard deviation of a depth z: `a_m` + `b_per_m` z^2, of each pixel, and of an error that all share.

    Raises ValueError where a number is out of bounds.
    """

    a_m: float  # metres: what does not grow with the depth
    b_per_m: float  # per metre: what a disparity's error makes of depth
    scale_sigma: float = 0.005  # as a share of each depth, alike for all of a camera: its calibration

    def __post_init__(self) -> None:
        for what, number in (("a_m", self.a_m), ("b_per_m", self.b_per_m), ("scale_sigma", self.scale_sigma)):
            if not 0 <= number <= _MOST_SIGMA:
                raise ValueError(f"the noise of a depth image must have {what} of 0 to {_MOST_SIGMA:g}, got {number:g}")
            object.__setattr__(self, what, float(number))  # NumPy's, which no message takes
        if self.a_m + self.b_per_m < _LEAST_SIGMA:
            raise ValueError("the noise of a depth image must be above 1 nm: give a_m, b_per_m or both")

    def compute_sigma(self, depth: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Standard deviation of depths, metres, of the same shape."""
        return self.a_m + self.b_per_m * np.asarray(depth, np.float64) ** 2


# Standard deviations where nobody tells any, by the kind of the depth camera.
NOISES = {
    "stereo": DepthNoise(0.002, 0.008),  # an OAK or a RealSense D4xx: .25 pixels of disparity at 7.5 cm
    "structured_light": DepthNoise(0.0015, 0.003),  # the first Kinect (Khoshelham and Elberink 2012)
    "time_of_flight": DepthNoise(0.005, 0.001),  # Azure Kinect, OAK-D ToF
    "lidar": DepthNoise(0.01, 0.0025),  # of a telephone, smoothed by its maker
}
USUAL_KIND = "stereo"  # the noisiest: what is not known is not believed too much


def find_noise(kind: str) -> DepthNoise:
    """The noise of a kind of depth camera. Raises ValueError where there is no such kind."""
    if kind not in NOISES:
        raise ValueError(f"the kind of a depth camera must be one of {', '.join(NOISES)}, got {kind[:40]!a}")
    return NOISES[kind]


def _check_shape(columns: int, rows: int, width: int, height: int, of: str) -> None:
    """Raises ValueError unless a depth image has the shape of another size, to a pixel."""
    if abs(columns * height - rows * width) > max(width, height) + max(columns, rows):
        raise ValueError(
            f"a depth image must have the shape of {of}, {width} x {height}; got {columns} x {rows}. Where it is not "
            "aligned, give the lens of the depth camera (intrinsics) and T_camera_depth"
        )


@dataclass(frozen=True, eq=False)
class DepthImage:
    """The z of what each pixel shows, 0 or not a number where it is not known.

    It is aligned where it has neither a lens nor a place of its own: its pixels are those of the frame, whatever its
    size. Raises ValueError where an array or a number is none of a depth image.
    """

    values: npt.NDArray[np.uint16] | npt.NDArray[np.float32] = field(repr=False)  # (H, W), steps of `unit_m`
    unit_m: float = MILLIMETRE  # metres of a step: 0.001 where values are millimetres, 1 where they are metres
    intrinsics: Intrinsics | None = None  # of the depth camera; None: the frame's, if it has any
    T_camera_depth: tuple[float, ...] = ALIGNED  # row by row, metres: where the depth camera is beside the frame's
    noise: DepthNoise = NOISES[USUAL_KIND]  # how unsure each depth is
    confidence: npt.NDArray[np.uint8] | None = field(default=None, repr=False)  # (H, W), 0: not believed; 255: wholly

    def __post_init__(self) -> None:
        values = self.values
        if values.ndim != 2 or values.dtype not in (np.uint16, np.float32):
            raise ValueError(f"a depth image must be (H, W) uint16 or float32, got {values.shape} {values.dtype}")
        if not 1 <= min(values.shape) <= max(values.shape) <= LARGEST_SIDE or values.size > MOST_PIXELS:
            raise ValueError(f"a depth image must have 1 to {MOST_PIXELS} pixels, got {values.shape}")
        if not _UNITS_M[0] <= self.unit_m <= _UNITS_M[1]:
            raise ValueError(
                f"the unit of a depth image must be {_UNITS_M[0]:g} to {_UNITS_M[1]:g} m, got {self.unit_m:g}"
            )
        if problem := rigid_problem(self.T_camera_depth):
            raise ValueError(f"T_camera_depth must be {problem}")
        offset = math.hypot(*self.T_camera_depth[3:12:4])
        if offset > _LARGEST_OFFSET_M:
            raise ValueError(
                f"the depth camera must be within {_LARGEST_OFFSET_M:g} m of the frame's, got {offset:.3g} m: "
                "T_camera_depth is in metres"
            )
        if self.intrinsics is not None:
            rows, columns = values.shape
            _check_shape(columns, rows, self.intrinsics.width, self.intrinsics.height, "its lens")
            self.intrinsics.resized(columns, rows)  # raises where that is no lens
        if self.T_camera_depth != ALIGNED and self.intrinsics is None:
            raise ValueError("a depth camera with a place of its own must have a lens of its own: give intrinsics")
        self._check_confidence()

    def _check_confidence(self) -> None:
        given = self.confidence
        if given is not None and (given.shape != self.values.shape or given.dtype != np.uint8):
            raise ValueError(
                f"the confidence of a depth image must be {self.values.shape} uint8, got {given.shape} {given.dtype}"
            )

    @property
    def is_aligned(self) -> bool:
        """Whether its pixels are those of the frame."""
        return self.intrinsics is None

    def check_beside(self, width: int, height: int) -> None:
        """Raises ValueError where it is aligned, and not of the shape of an image of this size."""
        rows, columns = self.values.shape
        if self.is_aligned:
            _check_shape(columns, rows, width, height, "its image")

    @property
    def metres(self) -> npt.NDArray[np.float32]:
        """(H, W) z in the depth camera's frame, metres; 0 where it is not known, or not believed at all."""
        z = self.values.astype(np.float32) * np.float32(self.unit_m)
        known = np.isfinite(z) & (z > 0) & (z <= FARTHEST_M)
        if self.confidence is not None:
            known &= self.confidence > 0
        return np.where(known, z, np.float32(0))

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """T_camera_depth (4, 4)."""
        return np.array(self.T_camera_depth, np.float64).reshape(4, 4)

    def apply_lens(self, lens: Intrinsics) -> DepthImage:
        """The same with the lens of its frame, where it is aligned: the frame's pixels are about to move."""
        return replace(self, intrinsics=lens) if self.is_aligned else self


def make_depth_image(
    values: npt.NDArray[Any],
    unit_m: float | None = None,
    intrinsics: Intrinsics | None = None,
    T_camera_depth: npt.NDArray[np.floating] | None = None,
    noise: DepthNoise | str = USUAL_KIND,
    confidence: npt.NDArray[np.uint8] | None = None,
) -> DepthImage:
    """A depth image of an array (H, W): whole numbers are millimetres, floats are metres, unless `unit_m` tells.

    They are depths z along the camera's axis, not distances along the rays.

    `noise` may name a kind of `NOISES`. Raises ValueError, where `unit_m` does not tell also of values that have
    another unit.
    """
    array = np.asarray(values)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.dtype.kind not in "fu" or array.dtype == np.uint8:
        raise ValueError(
            f"a depth image must be (H, W) uint16 of millimetres or float of metres, got {array.shape} {array.dtype}"
        )
    whole = array.dtype.kind == "u"
    if whole and array.dtype != np.uint16:
        if array.size and int(array.max()) > 65_535:
            raise ValueError(f"a depth image of whole numbers must be within 65535, got {int(array.max())}")
        array = array.astype(np.uint16)
    with np.errstate(over="ignore"):
        kept = np.ascontiguousarray(array, np.uint16) if whole else np.ascontiguousarray(array, np.float32)
    matrix = np.eye(4) if T_camera_depth is None else np.asarray(T_camera_depth, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"T_camera_depth must be (4, 4), got {matrix.shape}")
    model = find_noise(noise) if isinstance(noise, str) else noise
    unit = unit_m if unit_m is not None else (MILLIMETRE if whole else 1.0)
    lies = tuple(matrix.ravel().tolist())
    made = DepthImage(_clear_unknown(kept), float(unit), intrinsics, lies, model, confidence)
    if unit_m is None:
        check_unit(made)
    return made


def check_unit(depth: DepthImage) -> None:
    """Raises ValueError where the values of a depth image are so small or large that their unit is another one."""
    if problem := describe_wrong_unit(depth):
        raise ValueError(problem)


def describe_wrong_unit(depth: DepthImage) -> str:
    """Describes what tells that the values of a depth image have another unit; empty where nothing does."""
    known, unit_m = _find_known(depth), depth.unit_m
    if known.size < LEAST_KNOWN:
        return ""
    median = float(np.median(known))
    if depth.values.dtype == np.uint16 and median * unit_m < NEAREST_M:
        holds = "whole millimetres" if unit_m == MILLIMETRE else f"steps of {1000 * unit_m:g} mm"
        probably = (
            "probably metres; give float metres, or multiply by 1000"
            if median < _MOST_METRES
            else "probably another unit; give float metres, or tell unit_m"
        )
        return f"depth images of 16 bits hold {holds}; the median is {median:g}: {probably}"
    if depth.values.dtype == np.float32 and median * unit_m > FARTHEST_M:
        return (
            f"depth images of floats hold {'metres' if unit_m == 1.0 else f'steps of {unit_m:g} m'}; the median is "
            f"{median:g}: probably millimetres; divide by 1000, or tell unit_m=0.001"
        )
    return ""


def describe_doubtful_unit(depth: DepthImage) -> str:
    """Describes what speaks against the unit of a depth image, though it may be right; empty where nothing does."""
    if problem := describe_wrong_unit(depth):
        return problem
    known = _find_known(depth)
    if known.size < LEAST_KNOWN:
        return ""
    median = float(np.median(known)) * depth.unit_m
    if depth.values.dtype == np.float32 and median > USUAL_FARTHEST_M:
        return f"the median depth is {median:.4g} m: where floats are no metres, tell their unit (unit_m)"
    if depth.values.dtype == np.uint16 and (count := len(np.unique(known))) < _LEAST_DISTINCT:
        return f"{known.size} pixels have {count} different depths alone: check that values are millimetres of 16 bits"
    return ""


def _find_known(depth: DepthImage) -> npt.NDArray[Any]:
    """(M,) the values above 0."""
    return depth.values[depth.values > 0]


def _clear_unknown(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The values with 0 in place of what is no number or has no end."""
    if values.dtype.kind != "f" or np.isfinite(values).all():
        return values
    return np.where(np.isfinite(values), values, values.dtype.type(0))


# What a depth image is beside its arrays, in messages, checkpoints and recordings alike.

_Unit = Annotated[float, msgspec.Meta(ge=_UNITS_M[0], le=_UNITS_M[1])]


_Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]  # metres at most; `DepthImage` knows the rest


class DepthMeta(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Describes a depth image beside its arrays: its values, and its confidence where it has any."""

    unit_m: _Unit
    intrinsics: Intrinsics | None
    T_camera_depth: Annotated[tuple[_Number, ...], msgspec.Meta(min_length=16, max_length=16)]
    noise: DepthNoise
    has_confidence: bool = False

    @property
    def num_arrays(self) -> int:
        return 2 if self.has_confidence else 1


def describe_depth(depth: DepthImage) -> DepthMeta:
    """The fields beside its arrays."""
    return DepthMeta(
        depth.unit_m, depth.intrinsics, depth.T_camera_depth, depth.noise, has_confidence=depth.confidence is not None
    )


def depth_arrays(depth: DepthImage) -> list[npt.NDArray[Any]]:
    """Its values, and its confidence where it has any."""
    return [depth.values, *([] if depth.confidence is None else [depth.confidence])]


def read_depth(meta: DepthMeta, arrays: list[npt.NDArray[Any]]) -> DepthImage:
    """The depth image of which `describe_depth` and `depth_arrays` told. Raises ValueError where it is none."""
    if len(arrays) != meta.num_arrays:
        raise ValueError(f"a depth image must have {meta.num_arrays} arrays, got {len(arrays)}")
    confidence = arrays[1] if meta.has_confidence else None
    return DepthImage(
        _clear_unknown(arrays[0]), meta.unit_m, meta.intrinsics, meta.T_camera_depth, meta.noise, confidence
    )


# Depth images in files: PNG and TIFF of 16 bits, NumPy's, and OpenEXR as telephones write it.

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
    if notice := describe_few_pairs(len(found), len(names)):
        notify(log, notice)
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
