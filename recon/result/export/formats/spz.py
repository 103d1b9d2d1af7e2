""".spz: Niantic's compact scene format (version 2, which every reader knows), a fifth of the PLY file.

A gzip stream of a 16-byte header and one array an attribute: centres (24-bit fixed point), opacities, colours, log
scales (8 bits each), rotations (x, y and z of the quaternion in 8 bits each; version 3, which is read, has the three
smallest components in 10 bits each), spherical harmonics (8 bits, quantised to 5 and 4 so that they compress). Axes in
the file are right, up, back; ours are right, down, forward. Written from the description in the README of
github.com/nianticlabs/spz.

Three liberties make it small: Gaussians have no order, so they come in one in which bytes repeat; which of its axes is
the first says nothing of a Gaussian, so it is turned least; and digits that nobody sees are noise, so they are rounded
away. Against the PLY file, renders of six scenes keep 49 to 52 dB.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import (
    SceneFileError,
    check_count,
    make_unknown_source,
    minimize_rotations,
    select_gaussians,
)
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.snapshot import GaussianArrays

DEFAULT_NAME = "scene.spz"

_MAGIC, _VERSION = 0x5053474E, 2
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, reserved
_FLAG_EXTENSIONS = 0x2  # records follow that a reader may ignore
_LEAST_BYTES = 4  # of the compressed file for a Gaussian; scenes have 10 and more
_FEW_GAUSSIANS = 100_000  # that a file of any size may hold
_STEPS_IN_EXTENT = 12.5  # at least, of centres in a typical Gaussian's extent
_OPACITY_STEP, _COLOUR_STEP = 4, 2  # of what a byte could tell
_COLOUR_SCALE = 0.15  # smaller than the basis function's 0.28: colours may leave [0, 1] before SH brings them back
_NUM_BASES = {0: 1, 1: 4, 2: 9, 3: 16}

# Signs under (x, y, z) -> (x, -y, -z) of the bases in order: each is odd or even in y and in z.
_SH_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
_AXES = np.array([1, -1, -1], np.float32)


def export(result: StoredResult) -> bytes:
    return encode_spz(result.gaussians())


def encode_spz(gaussians: GaussianArrays) -> bytes:
    """The file's bytes, Gaussians by height in slices of depth. Scales and opacities must be positive and finite.

    Rounding errors: log scales 1/32, opacities 2/255, f_dc 1/38, rotations 1 degree, and centres 1/25 of a typical
    Gaussian's extent, or 2^-23 of the largest coordinate where that is more. See `sanitize_gaussians`.
    """
    num_gaussians, num_bases = gaussians.sh.shape[:2]
    degree = {bases: degree for degree, bases in _NUM_BASES.items()}[num_bases]
    bits = _choose_fractional_bits(gaussians)
    fixed = np.rint(gaussians.means.astype(np.float64) * _AXES * 2.0**bits).astype("<i4")
    order = np.lexsort((fixed[:, 1], fixed[:, 2]))
    fixed, ordered = fixed[order], minimize_rotations(select_gaussians(gaussians, order))
    parts = [
        _HEADER.pack(_MAGIC, _VERSION, num_gaussians, degree, bits, 0, 0),
        np.ascontiguousarray(fixed.view(np.uint8).reshape(-1, 4)[:, :3]).tobytes(),
        _quantize(ordered.opacities * 255.0, _OPACITY_STEP),
        _quantize(ordered.sh[:, 0] * (_COLOUR_SCALE * 255.0) + 127.5, _COLOUR_STEP),
        _quantize((np.log(ordered.scales) + 10.0) * 16.0),
        _quantize((ordered.quats[:, 1:] * _AXES + 1.0) * 127.5),  # w is positive
        _pack_sh(ordered.sh[:, 1:] * _SH_SIGNS[1:num_bases, None]),
    ]
    compressor = zlib.compressobj(9, zlib.DEFLATED, 16 + zlib.MAX_WBITS)  # 16: a gzip wrapper, without a time stamp
    return compressor.compress(b"".join(parts)) + compressor.flush()


def decode(data: bytes, name: str = "scene.spz") -> GaussianArrays:
    """Reads versions 2 and 3. Raises SceneFileError, which names the file as `name`, for anything else."""
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    version, num_gaussians, degree, bits, flags = _parse_header(_inflate(stream, data, _HEADER.size, name), name)
    num_bases = _NUM_BASES[degree]
    check_count(num_gaussians, num_bases, name)
    if num_gaussians > _FEW_GAUSSIANS + len(data) // _LEAST_BYTES:
        raise SceneFileError(
            f"{name} is damaged: {len(data)} bytes cannot hold the {num_gaussians} Gaussians it promises"
        )
    widths = (9, 1, 3, 3, 4 if version == 3 else 3, 3 * (num_bases - 1))
    size = num_gaussians * sum(widths)
    body = _inflate(stream, stream.unconsumed_tail, size, name)
    if len(body) < size:
        raise SceneFileError(
            f"{name} is truncated: its header promises {size} bytes for {num_gaussians} Gaussians, {len(body)} are "
            "there. Copy or export it again"
        )
    if not flags & _FLAG_EXTENSIONS and _inflate(stream, stream.unconsumed_tail, 1, name):
        raise SceneFileError(f"{name} holds more than the {num_gaussians} Gaussians that its header promises")
    ends = np.cumsum([num_gaussians * width for width in widths])[:-1]
    columns = np.split(np.frombuffer(body, np.uint8), ends)
    centre, alpha, colour, scale, quat, sh = (
        column.reshape(num_gaussians, width) for column, width in zip(columns, widths, strict=True)
    )
    rest = (sh.reshape(num_gaussians, num_bases - 1, 3).astype(np.float32) - 128.0) / 128.0
    return GaussianArrays(
        means=_unpack_fixed(centre) * np.float32(2.0**-bits) * _AXES,
        quats=_unpack_smallest_three(quat.copy().view("<u4")[:, 0]) if version == 3 else _unpack_first_three(quat),
        scales=np.exp(scale.astype(np.float32) / 16.0 - 10.0),
        opacities=alpha[:, 0].astype(np.float32) / 255.0,
        sh=np.concatenate(
            [
                ((colour.astype(np.float32) / 255.0 - 0.5) / _COLOUR_SCALE)[:, None],
                rest * _SH_SIGNS[1:num_bases, None],
            ],
            axis=1,
        ),
        source_frame=make_unknown_source(num_gaussians),
    )


def _parse_header(header: bytes, name: str) -> tuple[int, int, int, int, int]:
    """(version, count, SH degree, fractional bits, flags), all within bounds."""
    if len(header) < _HEADER.size:
        raise SceneFileError(f"{name} is truncated: it ends within its header")
    magic, version, count, degree, bits, flags, _ = _HEADER.unpack(header)
    if magic != _MAGIC:
        raise SceneFileError(f"{name} is compressed but not a .spz file: its signature is {header[:4]!r}, not b'NGSP'")
    if version not in (2, 3):
        raise SceneFileError(f"{name} is .spz version {version}; versions 2 and 3 can be read. Save it as version 3")
    if degree not in _NUM_BASES:
        raise SceneFileError(f"{name} has spherical harmonics of degree {degree}; 0 to 3 can be read")
    if bits > 23:
        raise SceneFileError(f"{name} has an impossible header: {bits} fractional bits")
    return version, count, degree, bits, flags


def _inflate(stream, data: bytes, size: int, name: str) -> bytes:
    """At most `size` further bytes of the stream, so that a small file cannot fill the memory."""
    if size == 0:
        return b""
    try:
        return stream.decompress(data, size)
    except zlib.error as error:
        raise SceneFileError(f"{name} is not a .spz file or is damaged: {error}") from error


def _quantize(values: npt.NDArray, step: int | npt.NDArray = 1) -> bytes:
    """Rounded to multiples of `step`, as far as these fit."""
    return np.clip(np.rint(values / step) * step, 0, 255).astype(np.uint8).tobytes()


def _choose_fractional_bits(gaussians: GaussianArrays) -> int:
    """As many as the extents call for and let the largest coordinate fit in 24 bits: our scenes' scale is arbitrary."""
    if not len(gaussians):
        return 0
    largest = float(np.abs(gaussians.means).max())
    fitting = int(np.floor(np.log2((2**23 - 1) / max(largest, 1.0))))
    if fitting < 0:
        raise ValueError(f"centres must be within 2^23 of the origin for .spz, the farthest is at {largest:g}")
    extent = float(np.median(np.sort(gaussians.scales, axis=1)[:, 1]))
    telling = int(np.ceil(np.log2(_STEPS_IN_EXTENT / extent)))
    return min(fitting, max(telling, 0))


def _unpack_fixed(centre: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """(N, 9) bytes as (N, 3) integers: shifted into the top 24 of 32 bits, so that the sign extends by itself."""
    wide = np.zeros((len(centre), 3, 4), np.uint8)
    wide[..., 1:] = centre.reshape(-1, 3, 3)
    return (wide.view("<i4")[..., 0] >> 8).astype(np.float32)


def _unpack_smallest_three(packed: npt.NDArray[np.uint32]) -> npt.NDArray[np.float32]:
    """Version 3: 2 bits for the largest component's index in xyzw, then sign and 9 bits for each of the others."""
    largest = (packed >> 30).astype(np.intp)
    xyzw = np.zeros((len(packed), 4))
    for i in (3, 2, 1, 0):
        value = (packed & 511) / 511.0 * np.sqrt(0.5) * np.where(packed >> 9 & 1, -1.0, 1.0)
        xyzw[:, i] = np.where(largest == i, 0.0, value)
        packed = np.where(largest == i, packed, packed >> 10)
    xyzw[np.arange(len(packed)), largest] = np.sqrt(np.maximum(1.0 - (xyzw**2).sum(1), 0.0))
    return _convert_axes(xyzw)


def _unpack_first_three(quat: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Version 2: x, y and z in 8 bits; w is what they leave."""
    xyz = quat / 127.5 - 1.0
    return _convert_axes(np.concatenate([xyz, np.sqrt(np.maximum(1.0 - (xyz**2).sum(1, keepdims=True), 0.0))], 1))


def _convert_axes(xyzw: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    wxyz = xyzw[:, [3, 0, 1, 2]] * np.array([1, *_AXES])
    return (wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)).astype(np.float32)


def _pack_sh(rest: npt.NDArray[np.float32]) -> bytes:
    """Coefficients in [-1, 1], rounded to 5 bits (degree 1) and 4 bits (above) so that 0 stays 0."""
    step = np.where(np.arange(rest.shape[1]) < 3, 8, 16)[:, None]
    return _quantize(rest * 128.0 + 128.0, step)
