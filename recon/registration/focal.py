"""Focal length before anything is reconstructed: a vote of the pairs of frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.matching.two_view import TwoView

# Focal lengths are counted over the longer side of the image.
_MIN_RATIO, _MAX_RATIO = 0.3, 5.0  # 118 to 11 degrees of view: beyond, a pair's own estimate is a failure
_GRID = np.geomspace(_MIN_RATIO, _MAX_RATIO, 240)  # of candidates, 1.2 % apart

_TYPICAL_RATIO = 1.0  # of phones and webcams: 53 degrees of view
_TYPICAL_SIGMA = 0.35  # of log focal around it
_TYPICAL_WEIGHT = 30.0  # matches that it counts as much as: a pair has hundreds

_VOTE_SIGMA = 0.06  # of log focal: the spread of the estimates of single pairs
_MIN_DISTANCE = 0.15  # between two candidates, of log focal: nearer ones lead to the same map


def vote(pairs: Sequence[TwoView], num_candidates: int) -> tuple[float, ...]:
    """The most likely ratios of focal length to longer side, the best first.

    A pair votes by a Gaussian kernel in log focal, with the number of its matches that neither a plane nor a rotation
    explains: these leave the focal length open. A weak prior around typical lenses settles what is undecided.
    """
    density = _TYPICAL_WEIGHT * np.exp(-0.5 * (np.log(_GRID / _TYPICAL_RATIO) / _TYPICAL_SIGMA) ** 2)
    for pair in pairs:
        count = len(pair.matches)
        if not _MIN_RATIO < pair.focal_ratio < _MAX_RATIO:
            continue
        weight = count * max(0.0, 1.0 - max(pair.num_homography, pair.num_rotation) / count)
        density += weight * np.exp(-0.5 * (np.log(_GRID / pair.focal_ratio) / _VOTE_SIGMA) ** 2)
    chosen: list[float] = []
    remaining: npt.NDArray[np.float64] = density
    for _ in range(num_candidates):
        best = float(_GRID[int(remaining.argmax())])
        chosen.append(best)
        remaining = remaining * (np.abs(np.log(_GRID / best)) > _MIN_DISTANCE)
    return tuple(chosen)
