"""Focal lengths before anything else is known: what EXIF says, and what pairs of frames vote for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.matching.two_view import TwoView

TYPICAL_RATIO = 1.0  # focal length over the longer side of phones and webcams (53 degrees field of view)
_GRID = np.geomspace(0.3, 5.0, 240)


def vote(pairs: Sequence[TwoView], num_candidates: int, kernel: float = 0.06) -> tuple[float, ...]:
    """The most likely ratios of focal length to longer side, best first.

    A pair votes by its number of matches, with a kernel in log focal, and only by the share of them that a plane does
    not explain: a plane leaves the focal length open. A weak prior around typical lenses settles what is undecided.
    """
    density = 30.0 * np.exp(-0.5 * (np.log(_GRID / TYPICAL_RATIO) / 0.35) ** 2)
    for pair in pairs:
        count = len(pair.matches)
        if not 0.3 < pair.focal_ratio < 5.0:
            continue
        weight = count * max(0.0, 1.0 - max(pair.num_homography, pair.num_rotation) / count)
        density += weight * np.exp(-0.5 * (np.log(_GRID / pair.focal_ratio) / kernel) ** 2)
    chosen: list[float] = []
    remaining: npt.NDArray[np.float64] = density
    for _ in range(num_candidates):
        best = float(_GRID[int(remaining.argmax())])
        chosen.append(best)
        remaining = remaining * (np.abs(np.log(_GRID / best)) > 0.15)
    return tuple(chosen)
