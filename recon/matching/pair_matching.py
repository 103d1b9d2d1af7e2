"""Matching of two keyframes: descriptor matches, and the two-view geometry that verifies them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.recon.frames.keyframe import (
    LIBRARY_ERRORS,
    PLAIN,
    Features,
    Keyframe,
    longer_side,
    principal_point,
)
from splatnode.recon.matching import appearance_check, nearest_neighbours, two_view
from splatnode.recon.matching.two_view import TwoView

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class PairMatchingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    nearest_neighbours: nearest_neighbours.NearestNeighbourConfig = nearest_neighbours.NearestNeighbourConfig()
    two_view: two_view.TwoViewConfig = two_view.TwoViewConfig()
    max_static_px: float = 1.0  # median motion below which matches may show the robot itself, pixels at REFERENCE_SIDE
    min_moving: int = 60  # matches that move by more, for a geometry of these alone


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """The matches of two keyframes and what they agree on."""

    matches: Index  # (M, 2) candidates: point numbers in both keyframes, the most distinct match first
    geometry: TwoView | None  # None where chance explains as much agreement
    log10_nfa: float  # log10 of the number of false alarms, also without geometry: below 0 it hints at an overlap


def glance(keyframe1: Keyframe, keyframe2: Keyframe, num_features: int, config: PairMatchingConfig) -> int:
    """The number of descriptor matches of the strongest plain features of both images: a hint at an overlap."""
    first, second = (
        keyframe.features.select_tilt(PLAIN).descriptors[:num_features] for keyframe in (keyframe1, keyframe2)
    )
    return len(nearest_neighbours.match(first, second, config.nearest_neighbours))


def match_plain(keyframe1: Keyframe, keyframe2: Keyframe, config: PairMatchingConfig) -> MatchedPair:
    """Matches the features of both images as they are."""
    matches = _match(keyframe1.features, keyframe2.features, (PLAIN, PLAIN), config.nearest_neighbours)
    return _verify_matches(keyframe1, keyframe2, matches, config)


def match_affine(
    keyframe1: Keyframe, keyframe2: Keyframe, known: MatchedPair, tilts: Sequence[float], config: PairMatchingConfig
) -> MatchedPair:
    """Adds matches of features with the simulated `tilts` to those that are `known`.

    One of the two images is always plain: a surface is seen from the side in one of them, not in both.
    """
    both_ways = sorted({(PLAIN, tilt) for tilt in tilts} | {(tilt, PLAIN) for tilt in tilts})
    found = [known.matches]
    found += [_match(keyframe1.features, keyframe2.features, both, config.nearest_neighbours) for both in both_ways]
    return _verify_matches(keyframe1, keyframe2, _merge_matches(found), config)


def add_proposed(
    keyframe1: Keyframe, keyframe2: Keyframe, known: MatchedPair, proposed: Index, config: PairMatchingConfig
) -> MatchedPair:
    """Adds the matches that a prior proposes, (M, 2) point numbers, the most distinct first.

    A prior may invent matches with a consistent geometry: unless the matched points look alike, `known` is returned.
    """
    if not appearance_check.matches_look_alike(keyframe1, keyframe2, proposed):
        return known
    return _verify_matches(keyframe1, keyframe2, _merge_matches([known.matches, proposed]), config)


def median_motion_px(pair: TwoView, longer_side1: int, longer_side2: int) -> float:
    """Median motion of the pair's matches, pixels at REFERENCE_SIDE; each frame is scaled to that longer side."""
    scaled = pair.rescale(longer_side2 / longer_side1, 1.0)
    return float(np.median(two_view.motion_px(scaled.points1, scaled.points2, longer_side2)))


def _merge_matches(found: Sequence[Index]) -> Index:
    """(M, 2) the matches of several sets, the most distinct of each first; a point keeps its most distinct match."""
    rank = np.concatenate([np.arange(len(matches)) / max(1, len(matches)) for matches in found])
    merged = np.concatenate(found)[np.argsort(rank, kind="stable")]
    for side in (0, 1):
        _, first = np.unique(merged[:, side], return_index=True)
        merged = merged[np.sort(first)]
    return merged


def _match(
    features1: Features,
    features2: Features,
    tilts: tuple[float, float],
    config: nearest_neighbours.NearestNeighbourConfig,
) -> Index:
    """(M, 2) point numbers that match by the descriptors of these tilts, the most distinct match first."""
    first, second = (features.select_tilt(tilt) for features, tilt in zip((features1, features2), tilts, strict=True))
    match = nearest_neighbours.match(first.descriptors, second.descriptors, config)
    return np.stack([first.point_of[match[:, 0]], second.point_of[match[:, 1]]], 1)


def _verify_matches(
    keyframe1: Keyframe, keyframe2: Keyframe, matches: Index, config: PairMatchingConfig
) -> MatchedPair:
    """The matches with their two-view geometry; without one, and a line in the log, where a library fails on them."""
    try:
        return _estimate_geometry(keyframe1, keyframe2, matches, config)
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        log.warning("%s and %s count as sharing nothing: %s", keyframe1.name, keyframe2.name, error)
        return MatchedPair(matches, None, 0.0)


def _estimate_geometry(
    keyframe1: Keyframe, keyframe2: Keyframe, matches: Index, config: PairMatchingConfig
) -> MatchedPair:
    """The matches with their two-view geometry. Raises LIBRARY_ERRORS.

    The first frame is scaled to the longer side of the second: one focal length in pixels may then hold for both.
    """
    side = longer_side(keyframe2.frame)
    scale = side / longer_side(keyframe1.frame)
    points1 = scale * (keyframe1.features.points[matches[:, 0]] - principal_point(keyframe1.frame))
    points2 = keyframe2.features.points[matches[:, 1]] - principal_point(keyframe2.frame)
    size = (keyframe2.frame.width, keyframe2.frame.height)
    geometry, log10_nfa = two_view.estimate(points1, points2, matches, size, config.two_view)
    if geometry is not None and median_motion_px(geometry, side, side) < config.max_static_px:
        # Static matches may show the robot's own body: the geometry is estimated again from the moving ones alone.
        (moving,) = np.nonzero(two_view.motion_px(points1, points2, side) >= config.max_static_px)
        if len(moving) >= config.min_moving:
            again = two_view.estimate(points1[moving], points2[moving], matches[moving], size, config.two_view)
            geometry, log10_nfa = again if again[0] is not None else (geometry, log10_nfa)
    return MatchedPair(matches, geometry.rescale(1.0 / scale, 1.0) if geometry else None, log10_nfa)
