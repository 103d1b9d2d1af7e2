"""scene.ply: the layout of Kerbl et al. (3D Gaussian Splatting, 2023), which every viewer and editor reads.

Little-endian float32 a Gaussian: x y z, nx ny nz (zero), f_dc_0..2, f_rest_* (channel-major: all of red's coefficients,
then green's, then blue's), opacity (logit), scale_0..2 (log), rot_0..3 (wxyz).
"""

from __future__ import annotations

import re

import numpy as np

from splatnode.recon.result.export.limits import SceneFileError, check_count, make_unknown_source
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.recon.result.verdict import RELATIVE, Scale

DEFAULT_NAME = "scene.ply"

_LONGEST_HEADER = 65536
_MOST_DIGITS = 20  # of a count
_LONGER_HEADER = 8  # bytes by which a header with a large number exceeds one with a single digit
_NORMAL = ("nx", "ny", "nz")  # part of the layout, always zero and never read
_TYPES = {
    **{name: "<i1" for name in ("char", "int8")},
    **{name: "<u1" for name in ("uchar", "uint8")},
    **{name: "<i2" for name in ("short", "int16")},
    **{name: "<u2" for name in ("ushort", "uint16")},
    **{name: "<i4" for name in ("int", "int32")},
    **{name: "<u4" for name in ("uint", "uint32")},
    **{name: "<f4" for name in ("float", "float32")},
    **{name: "<f8" for name in ("double", "float64")},
}


def export(result: StoredResult) -> bytes:
    return encode_ply(result.gaussians(), result.scale())


def encode_ply(gaussians: GaussianArrays, scale: Scale = RELATIVE) -> bytes:
    """The file's bytes. Scales and opacities must be positive and finite (see `sanitize_gaussians`)."""
    num_gaussians, num_bases = gaussians.sh.shape[:2]
    names = _property_names(num_bases)
    rows = np.zeros((num_gaussians, len(names)), "<f4")
    rest = 9 + 3 * (num_bases - 1)
    rows[:, 0:3] = gaussians.means
    rows[:, 6:9] = gaussians.sh[:, 0]
    rows[:, 9:rest] = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(num_gaussians, rest - 9)
    opacities = gaussians.opacities.astype(np.float64)
    rows[:, rest] = np.log(opacities) - np.log1p(-opacities)
    rows[:, rest + 1 : rest + 4] = np.log(gaussians.scales)
    rows[:, rest + 4 : rest + 8] = gaussians.quats
    return _header(num_gaussians, num_bases, scale) + rows.tobytes()


def compute_ply_bytes(num_gaussians: int, num_bases: int, scale: Scale = RELATIVE) -> int:
    """The size of `encode_ply`'s result."""
    return len(_header(num_gaussians, num_bases, scale)) + 4 * num_gaussians * len(_property_names(num_bases))


def compute_max_gaussians(num_bytes: int, num_bases: int = 1) -> int:
    """How many Gaussians a file of at most that size holds; at least 1."""
    for_one = compute_ply_bytes(1, num_bases)
    further = (num_bytes - for_one - _LONGER_HEADER) // (4 * len(_property_names(num_bases)))
    return max(1, 1 + further)


def decode(data: bytes, name: str = "scene.ply") -> GaussianArrays:
    """Reads any binary little-endian PLY with these properties, in any order and among others.

    Raises SceneFileError, which names the file as `name`, where it is truncated or is not such a file.
    """
    num_gaussians, dtype, start = _parse_header(data, name)
    missing = [field for field in _property_names(1) if field not in (dtype.names or ()) and field not in _NORMAL]
    if missing:
        raise SceneFileError(
            f"{name} is a PLY file but not a Gaussian scene: it lacks the properties {', '.join(missing)}"
        )
    rests = {field for field in dtype.names or () if field.startswith("f_rest_")}
    num_rest = len(rests)
    if num_rest not in (0, 9, 24, 45) or rests != {f"f_rest_{i}" for i in range(num_rest)}:
        raise SceneFileError(f"{name} must have 0, 9, 24 or 45 properties f_rest_0, f_rest_1 ..., has {num_rest}")
    check_count(num_gaussians, 1 + num_rest // 3, name)
    if len(data) - start < num_gaussians * dtype.itemsize:
        raise SceneFileError(
            f"{name} is truncated: its header promises {num_gaussians} Gaussians of {dtype.itemsize} bytes, "
            f"{(len(data) - start) // dtype.itemsize} are there. Copy or export it again"
        )
    rows = np.frombuffer(data, dtype, num_gaussians, start)

    def columns(*names: str) -> np.ndarray:
        with np.errstate(all="ignore"):  # what is infinite or no number as a float32 is left out later
            return np.stack([rows[field].astype(np.float32) for field in names], 1)

    rest = columns(*(f"f_rest_{i}" for i in range(num_rest))) if num_rest else np.zeros((num_gaussians, 0), np.float32)
    rest = rest.reshape(num_gaussians, 3, num_rest // 3).transpose(0, 2, 1)
    with np.errstate(all="ignore"):
        return GaussianArrays(
            means=columns("x", "y", "z"),
            quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
            scales=np.exp(columns("scale_0", "scale_1", "scale_2")),
            opacities=(1.0 / (1.0 + np.exp(-columns("opacity")[:, 0]))).astype(np.float32),
            sh=np.concatenate([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest], 1),
            source_frame=make_unknown_source(num_gaussians),
        )


def _property_names(num_bases: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * (num_bases - 1))]
    start = ["x", "y", "z", *_NORMAL, "f_dc_0", "f_dc_1", "f_dc_2"]
    return [*start, *rest, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def _header(num_gaussians: int, num_bases: int, scale: Scale) -> bytes:
    # Some readers take the third line for the element and read lines until end_header, so the comment comes last.
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {num_gaussians}"]
    lines += [f"property float {field}" for field in _property_names(num_bases)]
    lines += [f"comment splatnode: scale {scale.word}, unit {scale.unit}, frame {scale.frame.name.value}", "end_header"]
    return ("\n".join(lines) + "\n").encode()


def _parse_header(data: bytes, name: str) -> tuple[int, np.dtype, int]:
    """(number of vertices, a vertex's layout, offset of the first)."""
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise SceneFileError(f"{name} is not a PLY file: it starts with {data[:4]!r}")
    end = re.search(rb"\nend_header\r?\n", data[:_LONGEST_HEADER])
    if end is None:
        raise SceneFileError(f"{name} is truncated or not a PLY file: its header has no end")
    elements: list[tuple[str, int]] = []
    properties: list[tuple[str, str]] = []
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, _] if kind != "binary_little_endian":
                raise SceneFileError(f"{name} must be a binary little-endian PLY file, is {kind}")
            case ["element", element, count] if count.isdecimal():
                if len(count) > _MOST_DIGITS:
                    raise SceneFileError(f"{name} is damaged: a count in its header has {len(count)} digits")
                elements.append((element, int(count)))
            case ["property", kind, field] if kind in _TYPES and len(elements) == 1:
                properties.append((field, _TYPES[kind]))
            case ["property", *_] if len(elements) == 1:
                raise SceneFileError(f"{name} has a property that no Gaussian scene has: {line!r}")
    if not elements or elements[0][0] != "vertex":
        raise SceneFileError(f"{name} must start with the element vertex, has {[e[0] for e in elements]}")
    try:
        return elements[0][1], np.dtype(properties), end.end()
    except ValueError as error:
        raise SceneFileError(f"{name} has a malformed header: {error}") from error
