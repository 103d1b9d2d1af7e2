"""What a Gaussian must satisfy before it is written: viewers trust their input, so files hold only sane values."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.camera_check import MAX_COORDINATE
from splatnode.recon.result.snapshot import GaussianArrays

SH_C0 = 0.5 / np.sqrt(np.pi)  # the constant basis function; splatnode.recon.scene.gaussians has it too, but needs torch

_FARTHEST = 1000.0  # times the median distance from the scene's middle; beyond it a viewer frames nothing else
_SCALE_LIMITS = (1e-7, 10.0)  # times the same distance
_OPACITY_LIMITS = (1e-6, 1.0 - 1e-6)  # a logit of 0 or 1 is infinite


def sanitize_gaussians(gaussians: GaussianArrays) -> GaussianArrays:
    """The Gaussians with finite values and bounded extents: what every file of a result holds.

    A Gaussian with a value that is not finite, or whose centre is absurdly far away, is left out; extents and opacities
    are clamped; quaternions get unit length.
    """
    finite = np.isfinite(gaussians.opacities)
    for values in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh):
        finite &= np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    finite &= (np.abs(gaussians.means) <= MAX_COORDINATE).all(axis=1)
    if not finite.any():
        return select_gaussians(gaussians, finite)
    middle = np.median(gaussians.means[finite], axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.linalg.norm((gaussians.means - middle).astype(np.float64), axis=1)
    reach = float(np.median(distance[finite])) or 1.0
    kept = select_gaussians(gaussians, finite & (distance <= _FARTHEST * reach))
    with np.errstate(over="ignore"):
        length = np.linalg.norm(kept.quats, axis=1, keepdims=True)
    is_rotation = (length > 1e-12) & np.isfinite(length)
    identity = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    return GaussianArrays(
        means=kept.means,
        quats=np.where(is_rotation, kept.quats / np.maximum(length, 1e-12), identity).astype(np.float32),
        scales=np.clip(kept.scales, _SCALE_LIMITS[0] * reach, _SCALE_LIMITS[1] * reach).astype(np.float32),
        opacities=np.clip(kept.opacities, *_OPACITY_LIMITS).astype(np.float32),
        sh=kept.sh,
        source_frame=kept.source_frame,
    )


def select_gaussians(gaussians: GaussianArrays, index: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> GaussianArrays:
    """The Gaussians at `index` (integers or a mask)."""
    return GaussianArrays(
        gaussians.means[index],
        gaussians.quats[index],
        gaussians.scales[index],
        gaussians.opacities[index],
        gaussians.sh[index],
        gaussians.source_frame[index],
    )


def compute_base_rgb(gaussians: GaussianArrays) -> npt.NDArray[np.uint8]:
    """(N, 3) colour without its view-dependent part."""
    return np.rint(np.clip(gaussians.sh[:, 0] * SH_C0 + 0.5, 0.0, 1.0) * 255.0).astype(np.uint8)


def make_unknown_source(num_gaussians: int) -> npt.NDArray[np.int32]:
    """(N,) -1: no scene format keeps the frame that a Gaussian came from."""
    return np.full(num_gaussians, -1, np.int32)
