"""Regions of space, and which submap sees each best: voxels whose size follows the resolution of the views."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

REGION_PX = 16.0  # side of a region in pixels of the camera that sees it best, up to a factor of 2
NOBODY = -1


def regions(points: npt.NDArray[np.floating], resolution: Array) -> npt.NDArray[np.intp]:
    """(M,) numbers of the regions that the points (M, 3) are in.

    `resolution` (M,) is in pixels a unit of length. A region is a cube with a side of a power of two; a place that is
    seen twice as finely has regions half as large. Points of no resolution share one region.
    """
    known = resolution > 0
    level = np.full(len(points), np.iinfo(np.int32).max, np.int64)
    level[known] = np.ceil(np.log2(REGION_PX / resolution[known])).astype(np.int64)
    side = np.exp2(np.where(known, level, 0).astype(np.float64))
    cells = np.where(known[:, None], np.floor(points / side[:, None]), 0.0).astype(np.int64)
    _, number = np.unique(np.column_stack([level, cells]), axis=0, return_inverse=True)
    return number.reshape(-1).astype(np.intp)


def owners(region: npt.NDArray[np.intp], quality: Array) -> npt.NDArray[np.intp]:
    """(M,) which of S submaps sees the region of each point best in the mean; NOBODY where none sees it.

    `region` (M,) are numbers from 0 on without gaps, `quality` (M, S) is not negative. Of equals the first wins.
    """
    sums = np.stack([np.bincount(region, column) for column in quality.T], 1)
    best = np.where(sums.max(1) > 0, sums.argmax(1), NOBODY)
    return best[region]
