"""What every rasteriser asks of its input."""

from __future__ import annotations

import math
from collections.abc import Collection

from torch import Tensor

from splatnode.recon.rasterize.reference import CHANNELS

SH_BASES = (1, 4, 9, 16)
MAX_SIDE = 16384  # pixels


def check_input(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    T_world_camera: Tensor,
    K: Tensor,
    width: int,
    height: int,
    channels: Collection[str],
    near: float,
    device_type: str,
) -> None:
    """Raises ValueError for the first shape, dtype, device or number that a rasteriser cannot take.

    Values of the Gaussians are not looked at: that takes time, and back-ends do it on the way. Nor are those of a
    camera that is not on the processor, which would have to wait for them.
    """
    gaussians = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    for name, tensor in {**gaussians, "T_world_camera": T_world_camera, "K": K}.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise ValueError(f"{name} must be a tensor of floats, got {kind}")
    for name, tensor in gaussians.items():
        if tensor.device.type != device_type:
            raise ValueError(f"{name} must be on {device_type} for this rasteriser, got {tensor.device}")
    count = means.shape[0] if means.dim() else 0
    for name, tensor, shape in (
        ("means", means, (count, 3)),
        ("quats", quats, (count, 4)),
        ("scales", scales, (count, 3)),
        ("opacities", opacities, (count,)),
        ("T_world_camera", T_world_camera, (4, 4)),
        ("K", K, (3, 3)),
    ):
        if tuple(tensor.shape) != shape:
            wanted = f"(N, {shape[-1]})" if name in ("means", "quats", "scales") else shape
            hint = f" (N = {count} from means)" if name != "means" and name in gaussians else ""
            raise ValueError(f"{name} must be {wanted}{hint}, got {tuple(tensor.shape)}")
    if sh.dim() != 3 or sh.shape[0] != count or sh.shape[1] not in SH_BASES or sh.shape[2] != 3:
        raise ValueError(f"sh must be ({count}, B, 3) with B in {SH_BASES}, got {tuple(sh.shape)}")
    for name, side in (("width", width), ("height", height)):
        if not isinstance(side, int) or not 1 <= side <= MAX_SIDE:
            raise ValueError(f"{name} must be an integer from 1 to {MAX_SIDE}, got {side!r}")
    unknown = set(channels) - set(CHANNELS)
    if unknown or not channels or isinstance(channels, str):
        raise ValueError(f"channels must be some of {CHANNELS}, got {channels!r}")
    if not 0 < near < float("inf"):
        raise ValueError(f"near must be positive, got {near}")
    if T_world_camera.device.type == "cpu":
        _check_pose(T_world_camera.detach())
    if K.device.type == "cpu":
        _check_intrinsics(K.detach())


def _check_pose(T_world_camera: Tensor) -> None:
    T = T_world_camera.tolist()
    if not all(math.isfinite(value) for row in T for value in row):
        raise ValueError(f"T_world_camera must be finite, got {T}")
    drift = max(
        abs(sum(T[i][k] * T[j][k] for k in range(3)) - (1.0 if i == j else 0.0)) for i in range(3) for j in range(i + 1)
    )
    if drift > 1e-2 or max(abs(value - last) for value, last in zip(T[3], (0, 0, 0, 1), strict=True)) > 1e-6:
        raise ValueError(f"T_world_camera must be a rigid transform (its rotation is off by {drift:.2g}), got {T}")


def _check_intrinsics(K: Tensor) -> None:
    matrix = K.tolist()
    if not all(math.isfinite(value) for row in matrix for value in row) or matrix[0][0] <= 0 or matrix[1][1] <= 0:
        raise ValueError(f"K must be finite with positive focal lengths, got {matrix}")
    if matrix[0][1] != 0 or matrix[1][0] != 0 or matrix[2] != [0, 0, 1]:
        raise ValueError(f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {matrix}")
