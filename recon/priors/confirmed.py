"""Depths that two photographs confirm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.priors import reprojection
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.workers import each

Mask = npt.NDArray[np.bool_]

LEAST_CONFIDENCE = 0.12  # of stereo for a depth that counts, as in recon.scene.completion
AGREEING = 0.02  # relative difference of two photographs' depths of one point
MOST_PARTNERS = 8  # other photographs that each is compared with: those that share most with it


def confirmed(pointmaps: Sequence[Pointmap]) -> list[Mask]:
    """(h, w) for each point map the pixels whose depth a point of another one confirms."""
    known = [pointmap.masked(pointmap.confidence >= LEAST_CONFIDENCE) for pointmap in pointmaps]
    partners = reprojection.overlapping(known, MOST_PARTNERS)

    def agrees(j: int) -> Mask:
        mine = known[j]
        mask = np.zeros(mine.depth.shape, bool)
        for i in partners[j]:
            there, _ = reprojection.nearest(known[i], mine)
            mask |= np.abs(there - mine.depth) < AGREEING * mine.depth
        return mask & (mine.depth > 0)

    return each(agrees, range(len(known)))
