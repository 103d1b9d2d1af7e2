"""Is all that was reconstructed one plane? Then a flat thing that moves may have been taken for the scene."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

NEAR = 0.01  # distance from a plane that counts as on it, in median depths
_SAMPLE = 400  # points that are looked at: the share is known to 2.5 % (one standard error)
_PLANES = 300  # tried, each through three of them
_SLIVER = 1e-4  # twice the area of a triangle that defines no plane


def compute_share_on_plane(points: Array, seed: int = 0) -> float:
    """The largest share of `points` (P, 3), whose median depth is 1, that lies on one plane (RANSAC); 0 without any.

    NaN where a point is not finite."""
    if not np.isfinite(points).all():
        return np.nan
    if len(points) < 3:
        return 0.0
    rng = np.random.default_rng(seed)
    sample = points[rng.permutation(len(points))[:_SAMPLE]]
    corners = sample[np.stack([rng.permutation(len(sample))[:3] for _ in range(_PLANES)])]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    wide = lengths > _SLIVER
    if not wide.any():
        return 0.0
    normals = normals[wide] / lengths[wide, None]
    offsets = (normals * corners[wide, 0]).sum(1)
    return float((np.abs(sample @ normals.T - offsets) < NEAR).mean(0).max())
