""".splat: 32 bytes a Gaussian, as browsers stream it (antimatter15/splat): no header, no view-dependent colour.

float32 x y z, float32 scales, uint8 RGBA, uint8 quaternion wxyz (q * 128 + 128); the most visible Gaussians come first,
so that a viewer can show a file that is still arriving.
"""

from __future__ import annotations

import numpy as np

from splatnode.recon.result.export.limits import (
    SH_C0,
    SceneFileError,
    check_count,
    compute_base_rgb,
    make_unknown_source,
    select_gaussians,
)
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.snapshot import GaussianArrays

DEFAULT_NAME = "scene.splat"

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_OTHER_SIGNATURES = (b"ply", b"\x1f\x8b")  # a renamed .ply or .spz


def export(result: StoredResult) -> bytes:
    return encode_splat(result.gaussians())


def encode_splat(gaussians: GaussianArrays) -> bytes:
    """The file's bytes, most visible Gaussian first."""
    visible = gaussians.opacities * gaussians.scales.astype(np.float64).prod(axis=1)
    ordered = select_gaussians(gaussians, np.argsort(-visible, kind="stable"))
    rows = np.empty(len(ordered), _ROW)
    rows["mean"], rows["scale"] = ordered.means, ordered.scales
    rows["rgba"][:, :3] = compute_base_rgb(ordered)
    rows["rgba"][:, 3] = np.rint(ordered.opacities * 255.0)
    rows["quat"] = np.clip(np.rint(ordered.quats * 128.0 + 128.0), 0, 255)
    return rows.tobytes()


def decode(data: bytes, name: str = "scene.splat") -> GaussianArrays:
    """Reads a .splat file. Raises SceneFileError where the bytes cannot be one (the format has no signature)."""
    if not data or len(data) % _ROW.itemsize or data.startswith(_OTHER_SIGNATURES):
        raise SceneFileError(
            f"{name} is truncated or not a .splat file: its size must be a multiple of {_ROW.itemsize} bytes, is "
            f"{len(data)}; it starts with {data[:4]!r}"
        )
    check_count(len(data) // _ROW.itemsize, 1, name)
    rows = np.frombuffer(data, _ROW)
    quats = (rows["quat"].astype(np.float32) - 128.0) / 128.0
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    if not np.isfinite(rows["mean"]).all() or not (rows["scale"] > 0).all() or not (length > 0).all():
        raise SceneFileError(f"{name} is not a .splat file: centres, scales or rotations are impossible")
    return GaussianArrays(
        means=rows["mean"].copy(),
        quats=quats / length,
        scales=rows["scale"].copy(),
        opacities=rows["rgba"][:, 3].astype(np.float32) / 255.0,
        sh=((rows["rgba"][:, None, :3] / 255.0 - 0.5) / SH_C0).astype(np.float32),
        source_frame=make_unknown_source(len(rows)),
    )
