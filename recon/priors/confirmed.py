"""Depths that two photographs confirm, and what of them a result keeps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.priors import reprojection
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.workers import map_parallel

Mask = npt.NDArray[np.bool_]

LEAST_CONFIDENCE = 0.12  # of stereo for a depth that counts, as in recon.scene.completion
AGREEING = 0.02  # relative difference of two photographs' depths of one point
REDUCTION = 2  # pixels along each axis of which a result keeps one depth
MOST_PARTNERS = 8  # other photographs that each is compared with: those that share most with it


def find_consistent_pixels(pointmaps: Sequence[Pointmap]) -> list[Mask]:
    """(h, w) for each point map the pixels whose depth a point of another one confirms."""
    known = [pointmap.apply_mask(pointmap.confidence >= LEAST_CONFIDENCE) for pointmap in pointmaps]
    partners = reprojection.find_overlapping(known, MOST_PARTNERS)

    def agrees(j: int) -> Mask:
        mine = known[j]
        mask = np.zeros(mine.depth.shape, bool)
        for i in partners[j]:
            there, _ = reprojection.project_nearest(known[i], mine)
            mask |= np.abs(there - mine.depth) < AGREEING * mine.depth
        return mask & (mine.depth > 0)

    return map_parallel(agrees, range(len(known)))


def compute_consistent_shares(masks: Sequence[Mask], used: Sequence[Mask]) -> list[float]:
    """The share of each view's used pixels (h, w) whose depth is multi-view consistent, by the masks of `find_consistent_pixels`.

    It is 0 for a view of which nothing is used.
    """
    return [float(mask[own].mean()) if own.any() else 0.0 for mask, own in zip(masks, used, strict=True)]


def compute_consistent_depths(pointmaps: Sequence[Pointmap]) -> dict[str, npt.NDArray[np.float16]]:
    """Computes consistent depths by image, one for REDUCTION squared pixels; 0 where there is none.

    It is the mean of those of the square that are confirmed, at least half of its pixels, where these show one surface:
    at outlines nothing is kept.
    """
    return {
        pointmap.name: _reduce_depth(np.where(mask, pointmap.depth, np.float32(0)))
        for pointmap, mask in zip(pointmaps, find_consistent_pixels(pointmaps), strict=True)
    }


def _reduce_depth(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float16]:
    height, width = (side // REDUCTION for side in depth.shape)
    squares = depth[: height * REDUCTION, : width * REDUCTION].reshape(height, REDUCTION, width, REDUCTION)
    count = (squares > 0).sum((1, 3))
    near, far = np.where(squares > 0, squares, np.inf).min((1, 3)), squares.max((1, 3))
    sure = (2 * count >= REDUCTION**2) & (far - near < AGREEING * near)
    return np.where(sure, squares.sum((1, 3)) / np.maximum(count, 1), 0.0).astype(np.float16)
