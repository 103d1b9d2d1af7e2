"""Surfaces: which voxels a surface is in that two photographs confirm."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.layout import Layout
from splatnode.recon.occupancy.sight import DepthObservation

BLUR = 0.008  # of a depth, by which it may well be wrong: nine of ten are better
LEAST_POINTS = 2  # pixels of confirmed depth in a voxel: a single one may be a blend of what is before and behind


def find_surface_voxels(parts: Iterable[npt.NDArray[np.float64]], layout: Layout) -> npt.NDArray[np.bool_]:
    """(X, Y, Z) the voxels with at least LEAST_POINTS of all surface points (M, 3), in the map's frame.

    They come in parts, as of one camera each, so that a map of many cameras takes no more memory than one of a few.
    """
    counts = np.zeros(int(np.prod(layout.shape)), np.int32)
    for points in parts:
        index = np.floor(points / layout.voxel).astype(np.int64) - layout.first
        inside = ((index >= 0) & (index < layout.shape)).all(1)
        voxels, times = np.unique(np.ravel_multi_index(tuple(index[inside].T), layout.shape), return_counts=True)
        counts[voxels] += times.astype(np.int32)
    return (counts >= LEAST_POINTS).reshape(layout.shape)


def thicken_points(sight: DepthObservation) -> npt.NDArray[np.float64]:
    """(3 M, 3) world points of a camera: each a little nearer, where it is, and a little farther.

    So a surface beside a voxel's side is in both voxels, as which of them it is in cannot be known.
    """
    centre, points = sight.T_world_camera[:3, 3], sight.points
    return np.concatenate([centre + (1.0 + part) * (points - centre) for part in (-BLUR, 0.0, BLUR)])
