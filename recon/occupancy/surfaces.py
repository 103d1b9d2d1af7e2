"""Surfaces: which voxels a surface is in that two photographs confirm."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.layout import Layout
from splatnode.recon.occupancy.sight import Sight

BLUR = 0.008  # of a depth, by which it may well be wrong: nine of ten are better
LEAST_POINTS = 2  # pixels of confirmed depth in a voxel: a single one may be a blend of what is before and behind


def surfaces(points: npt.NDArray[np.float64], layout: Layout) -> npt.NDArray[np.bool_]:
    """(X, Y, Z) the voxels with at least LEAST_POINTS of the surface points (M, 3), in the map's frame."""
    index = np.floor(points / layout.voxel).astype(np.int64) - layout.first
    inside = ((index >= 0) & (index < layout.shape)).all(1)
    flat = np.ravel_multi_index(tuple(index[inside].T), layout.shape)
    counts = np.bincount(flat, minlength=int(np.prod(layout.shape)))
    return (counts >= LEAST_POINTS).reshape(layout.shape)


def blurred(sight: Sight) -> npt.NDArray[np.float64]:
    """(3 M, 3) world points of a camera: each a little nearer, where it is, and a little farther.

    So a surface beside a voxel's side is in both voxels, as which of them it is in cannot be known.
    """
    centre, points = sight.T_world_camera[:3, 3], sight.points.astype(np.float64)
    return np.concatenate([centre + (1.0 + part) * (points - centre) for part in (-BLUR, 0.0, BLUR)])
