"""What the features of two frames say about each other: their matches, and the geometry that these agree on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Features, Keyframe, longer_side, principal_point
from splatnode.recon.matching import appearance_check, nearest_neighbours, two_view
from splatnode.recon.matching.config import Config
from splatnode.recon.matching.two_view import TwoView

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Compared:
    """What the features of two frames say."""

    matches: Index  # (M, 2) points, most distinct first
    pair: TwoView | None  # None where chance explains the matches
    log10_nfa: float  # of the matches' agreement, whether it is enough or not: below 0 it is a hint


def compare(keyframe1: Keyframe, keyframe2: Keyframe, config: Config) -> Compared:
    """Matches the features of the plain images of two keyframes and verifies the pair."""
    found = _match(keyframe1.features, keyframe2.features, (1.0, 1.0), config.nearest_neighbours)
    return _examine(keyframe1, keyframe2, found, config)


def compare_squeezed(keyframe1: Keyframe, keyframe2: Keyframe, plain: Compared, config: Config) -> Compared:
    """The same with what the squeezed features add to the matches of the `plain` ones.

    One of the two images is always the plain one: a surface is seen from the side in one image, not in both. Every
    point is in one match at most, in the most distinct.
    """
    from_the_side = {(1.0, squeeze) for squeeze in set(keyframe2.features.squeeze) - {1.0}}
    from_the_side |= {(squeeze, 1.0) for squeeze in set(keyframe1.features.squeeze) - {1.0}}
    found = [plain.matches]
    found += [
        _match(keyframe1.features, keyframe2.features, squeezes, config.nearest_neighbours)
        for squeezes in sorted(from_the_side)
    ]
    return _examine(keyframe1, keyframe2, _merged(found), config)


def compare_further(keyframe1: Keyframe, keyframe2: Keyframe, known: Compared, more: Index, config: Config) -> Compared:
    """The same with `more` matches (M, 2) of the keyframes' points, most distinct first, beside the `known` ones.

    They come from a prior, which may invent: what does not look alike is not taken.
    """
    if not appearance_check.alike(keyframe1, keyframe2, more):
        return known
    return _examine(keyframe1, keyframe2, _merged([known.matches, more]), config)


def _merged(found: Sequence[Index]) -> Index:
    """(M, 2) matches of several sets, the most distinct of each first; every point is in one match at most."""
    rank = np.concatenate([np.arange(len(matches)) / max(1, len(matches)) for matches in found])
    merged = np.concatenate(found)[np.argsort(rank, kind="stable")]
    for side in (0, 1):
        _, first = np.unique(merged[:, side], return_index=True)
        merged = merged[np.sort(first)]
    return merged


def _match(
    features1: Features, features2: Features, squeezes: tuple[float, float], config: nearest_neighbours.Config
) -> Index:
    """(M, 2) indices of points that match by the descriptors of these squeezes, most distinct first."""
    (chosen1,), (chosen2,) = (
        np.nonzero(features.squeeze == squeeze)
        for features, squeeze in zip((features1, features2), squeezes, strict=True)
    )
    match = nearest_neighbours.match(features1.descriptors[chosen1], features2.descriptors[chosen2], config)
    return np.stack([features1.point_of[chosen1[match[:, 0]]], features2.point_of[chosen2[match[:, 1]]]], 1)


def _examine(keyframe1: Keyframe, keyframe2: Keyframe, matches: Index, config: Config) -> Compared:
    """One focal length may serve both frames if they count in pixels of one size: the first is taken as enlarged."""
    enlarged = longer_side(keyframe2.frame) / longer_side(keyframe1.frame)
    points1 = enlarged * (keyframe1.features.points[matches[:, 0]] - principal_point(keyframe1.frame))
    points2 = keyframe2.features.points[matches[:, 1]] - principal_point(keyframe2.frame)
    size = (keyframe2.frame.width, keyframe2.frame.height)
    pair, log10_nfa = two_view.examine(points1, points2, matches, size, config.two_view)
    if pair is not None and _motion_px(pair.points1, pair.points2, size) < config.still_px:
        # What stands still in both pictures may be the robot itself: what moves is asked by itself.
        (moved,) = np.nonzero(np.linalg.norm(points2 - points1, axis=1) * 1024.0 / max(size) >= config.still_px)
        if len(moved) >= config.enough_moved:
            among = two_view.examine(points1[moved], points2[moved], matches[moved], size, config.two_view)
            pair, log10_nfa = among if among[0] is not None else (pair, log10_nfa)
    return Compared(matches, pair.enlarged(1.0 / enlarged, 1.0) if pair else None, log10_nfa)


def _motion_px(points1: Array, points2: Array, size: tuple[int, int]) -> float:
    """Median motion at 1024 pixels on the longer side."""
    return float(np.median(np.linalg.norm(points2 - points1, axis=1))) * 1024.0 / max(size)
