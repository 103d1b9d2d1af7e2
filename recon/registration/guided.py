"""Matches along epipolar lines of given poses, for pairs in which plain matching found few.

The nearest descriptor among those near a feature's epipolar line is compared with the second nearest there, and not
with those of the whole image: what repeats elsewhere does not matter. Lines that are moved aside tell how many matches
come by chance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import cross_matrix
from splatnode.recon.keyframes import PLAIN, REFERENCE_SIDE, Keyframe, longer_side, principal_point
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration.known_poses import Given

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Index = npt.NDArray[np.int64]
Pair = tuple[int, int]

_FEW = 60  # matches of a pair from which on it needs no more
_MOST_PAIRS = 60  # that are looked at, those first whose cameras are nearest to each other
_STRONGEST = 3000  # features of an image that are compared
_RATIO = 0.8  # largest ratio of nearest to second-nearest distance
_WIDEST_PX, _LEAST_PX = 24.0, 2.0  # of the band on each side of a line, at REFERENCE_SIDE
_SIGMAS = 3.0  # of the given poses, in pixels: how wide the band is
_BY_CHANCE, _LEAST = 2.5, 12  # times as many as beside the lines, and so many more, must match along them
_ASIDE = (-3.0, 3.0)  # band widths by which lines are moved to see what matches by chance
_ROWS = 512  # features that are compared at once


def add_guided_matches(
    keyframes: Sequence[Keyframe], pairs: Mapping[Pair, TwoView], given: Given
) -> dict[Pair, TwoView]:
    """The pairs, and matches along epipolar lines for those of two given poses that have few."""
    known, centres = np.flatnonzero(given.poses.is_held).tolist(), given.poses.centres
    few = [(i, j) for i in known for j in known if i < j and ((i, j) not in pairs or len(pairs[i, j].matches) < _FEW)]
    few.sort(key=lambda pair: (float(np.linalg.norm(centres[pair[0]] - centres[pair[1]])), pair))
    found = dict(pairs)
    for i, j in few[:_MOST_PAIRS]:
        matches = _along_lines(keyframes[i], keyframes[j], given, (i, j))
        if len(matches):
            found[i, j] = _join_matches(found.get((i, j)), matches, keyframes[i], keyframes[j])
    return dict(sorted(found.items()))


def _along_lines(one: Keyframe, other: Keyframe, given: Given, pair: Pair) -> Index:
    """(M, 2) point numbers; none where as many match beside the lines."""
    descriptors, rays, points = [], [], []
    for keyframe in (one, other):
        plain = keyframe.features.select_tilt(PLAIN)
        chosen = plain.point_of[:_STRONGEST]
        descriptors.append(plain.descriptors[:_STRONGEST].astype(np.float32))
        points.append(chosen)
        rays.append((keyframe.features.points[chosen] - principal_point(keyframe.frame)) / _focal(keyframe))
    if min(map(len, points)) < 2:
        return np.zeros((0, 2), np.int64)
    i, j = pair
    poses = given.poses
    rotation = poses.rotations[j] @ poses.rotations[i].T
    translation = poses.rotations[j] @ (poses.centres[i] - poses.centres[j])
    lines = np.c_[rays[0], np.ones(len(rays[0]))] @ (cross_matrix(translation[None])[0] @ rotation).T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    pixel = longer_side(other.frame) / REFERENCE_SIDE / _focal(other)  # at REFERENCE_SIDE, at depth 1
    turned = float(np.hypot(*(poses.sigmas[[i, j], 0] if poses.joint is None else given.angle_sigmas[[i, j]])))
    band = np.clip(_SIGMAS * np.sqrt(2.0) * turned / pixel, _LEAST_PX, _WIDEST_PX) * pixel
    along, *beside = _mutual(descriptors, lines, rays[1], band, (0.0, *_ASIDE))
    by_chance = max(map(len, beside))
    if len(along) < _BY_CHANCE * by_chance + _LEAST:
        return np.zeros((0, 2), np.int64)
    return np.stack([points[0][along[:, 0]], points[1][along[:, 1]]], 1)


def _mutual(
    descriptors: Sequence[Float32], lines: Array, rays: Array, band: float, moves: Sequence[float]
) -> list[Index]:
    """(M, 2) features, each the other's nearest within `band` of the line, clearly nearer than the second nearest.

    For the lines as they are moved aside by each of `moves` bands.
    """
    count, other = len(lines), len(rays)
    squared_norms = [(each**2).sum(1) for each in descriptors]
    nearest, distinct = np.full((len(moves), count), -1), np.zeros((len(moves), count), bool)
    back_squared, back = np.full((len(moves), other), np.inf, np.float32), np.full((len(moves), other), -1)
    for start in range(0, count, _ROWS):
        rows = slice(start, start + _ROWS)
        every = squared_norms[0][rows, None] + squared_norms[1] - 2.0 * descriptors[0][rows] @ descriptors[1].T
        away = (lines[rows, :2] @ rays.T + lines[rows, 2:]).astype(np.float32)
        numbers = np.arange(len(every))
        for k, move in enumerate(moves):
            squared = np.where(np.abs(away + np.float32(move * band)) > band, np.float32(np.inf), every)
            least = squared.argmin(0)
            values_back = squared[least, np.arange(other)]
            nearer = values_back < back_squared[k]
            back_squared[k, nearer], back[k, nearer] = values_back[nearer], start + least[nearer]
            first = squared.argmin(1)
            best = squared[numbers, first]
            squared[numbers, first] = np.inf
            nearest[k, rows] = np.where(np.isfinite(best), first, -1)
            distinct[k, rows] = best < _RATIO**2 * squared.min(1)
    found = []
    for k in range(len(moves)):
        (kept,) = np.nonzero(distinct[k] & (nearest[k] >= 0))
        kept = kept[back[k, nearest[k, kept]] == kept]
        found.append(np.stack([kept, nearest[k, kept]], 1))
    return found


def _join_matches(known: TwoView | None, matches: Index, one: Keyframe, other: Keyframe) -> TwoView:
    """The pair's matches and those of these, in which neither point has a match yet."""
    if known is not None:
        fresh = ~np.isin(matches[:, 0], known.matches[:, 0]) & ~np.isin(matches[:, 1], known.matches[:, 1])
        matches = np.concatenate([known.matches, matches[fresh]])
    for side in (0, 1):
        _, first = np.unique(matches[:, side], return_index=True)
        matches = matches[np.sort(first)]
    points1 = one.features.points[matches[:, 0]] - principal_point(one.frame)
    points2 = other.features.points[matches[:, 1]] - principal_point(other.frame)
    ratio = _focal(other) / longer_side(other.frame)
    num_candidates = len(matches) if known is None else known.num_candidates
    log10_nfa = 0.0 if known is None else known.log10_nfa
    return TwoView(matches, points1, points2, num_candidates, log10_nfa, 0, 0, ratio, ratio)


def _focal(keyframe: Keyframe) -> float:
    lens = keyframe.frame.intrinsics
    if lens is None:
        raise AssertionError("a given pose counts where the lens is told")
    return lens.fx
