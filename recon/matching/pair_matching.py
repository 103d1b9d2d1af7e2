"""Matching of two keyframes: descriptor matches, and the two-view geometry that verifies them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.system import raise_shortage
from splatnode.recon.frames.keyframe import LIBRARY_ERRORS, PLAIN, Features, Keyframe, longer_side, principal_point
from splatnode.recon.matching import features as matching_features
from splatnode.recon.matching import two_view
from splatnode.recon.matching.candidates import find_components
from splatnode.recon.matching.features import describe
from splatnode.recon.matching.two_view import TwoView

# Appearance check of matches that a prior proposes: the matched points must look alike.
#
# A network may invent matches between unrelated images whose geometry is consistent. Invented matches look no more
# alike than points 16 px away from them.

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

# Lengths are in pixels of the image at modelled size.
_KEYPOINT_PX = 4.0  # size of the keypoints that are described
_RADIUS_PX = 12.0  # of the patch that a descriptor of that size covers
_OFFSET_PX = 16.0  # from a match to the points that it is compared with: more than a patch's radius
_MAX_MATCHES = 500  # that are examined: more take time and change no decision
_MIN_MATCHES = 9  # with fewer, the mean gain is too uncertain to say anything
_MIN_SIGMAS = 8.0  # of the mean gain above 0, in standard errors; patches of neighbours overlap, so errors are larger
_MIN_GAIN = 0.05  # mean gain in similarity, of 1: corners look a little more alike than what is beside them


def matches_look_alike(keyframe1: Keyframe, keyframe2: Keyframe, matches: Index) -> bool:
    """Whether the points of `matches` (M, 2) look more alike than the first point and points beside the second.

    False for too few matches, and for patches that look alike wherever they lie, as those of sky do.
    """
    chosen = matches[:: max(1, len(matches) // _MAX_MATCHES)]
    points1, points2 = (
        keyframe.features.points[points] * keyframe.scale
        for keyframe, points in ((keyframe1, chosen[:, 0]), (keyframe2, chosen[:, 1]))
    )
    inside = _inside(keyframe1, points1, _RADIUS_PX) & _inside(keyframe2, points2, _RADIUS_PX + _OFFSET_PX)
    points1, points2 = points1[inside], points2[inside]
    if len(points1) < _MIN_MATCHES:
        return False
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, len(points1))
    offset = _OFFSET_PX * np.stack([np.cos(angles), np.sin(angles)], 1)
    described1 = _describe(keyframe1, points1)
    at_match = (described1 * _describe(keyframe2, points2)).sum(1)
    beside = [(described1 * _describe(keyframe2, points2 + sign * offset)).sum(1) for sign in (-1, 1)]
    gain = at_match - np.mean(beside, axis=0)
    return float(gain.mean()) > max(_MIN_GAIN, _MIN_SIGMAS * float(gain.std()) / np.sqrt(len(points1)))


def _inside(keyframe: Keyframe, points: Array, margin: float) -> npt.NDArray[np.bool_]:
    """(M,) whether `points` (M, 2) are at least `margin` pixels from the border: patches cut off there look alike."""
    height, width = keyframe.image.shape[:2]
    return np.asarray(((points > margin) & (points < [width - margin, height - margin])).all(1))


def _describe(keyframe: Keyframe, points: Array) -> Array:
    """(M, 128) descriptors of unit length of the image at modelled size, upright, at its pixels `points` (M, 2)."""
    grey = np.asarray(cv2.cvtColor(keyframe.image, cv2.COLOR_RGB2GRAY), np.uint8)
    described = describe(grey, points, _KEYPOINT_PX).astype(np.float64)
    return described / np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-9)


log = logging.getLogger(__name__)


class PairMatchingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Matching of two keyframes: descriptor matches, and the two-view geometry that verifies them."""

    nearest_neighbours: matching_features.NearestNeighbourConfig = matching_features.NearestNeighbourConfig()
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
    return len(matching_features.match(first, second, config.nearest_neighbours))


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
    if not matches_look_alike(keyframe1, keyframe2, proposed):
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
    config: matching_features.NearestNeighbourConfig,
) -> Index:
    """(M, 2) point numbers that match by the descriptors of these tilts, the most distinct match first."""
    first, second = (features.select_tilt(tilt) for features, tilt in zip((features1, features2), tilts, strict=True))
    match = matching_features.match(first.descriptors, second.descriptors, config)
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


# Which pairs of keyframes are matched again with simulated tilts, which find more and take three times as long.


class AffineSimulationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which pairs of keyframes are matched again with simulated tilts, which find more and take three times as long."""

    tilts: tuple[float, ...] = (
        1.6,
    )  # by which the image's width is divided; below 1, its height multiplied; none: no pair is matched again
    firm_matches: int = 150  # verified matches that make a pair firm: it needs no tilted features
    enough_firm_pairs: int = 4  # firm pairs of a frame, so that it needs no more
    # log10 of the number of false alarms of a pair's plain matches below which the pair may overlap: of 40 pairs that
    # tilted features verified 39 were below it, of all others one in ten.
    hint_log10_nfa: float = -1.0


def is_strong_pair(geometry: TwoView | None, config: AffineSimulationConfig) -> bool:
    """Whether a pair has so many verified matches that nothing need be done to find more."""
    return geometry is not None and len(geometry.matches) >= config.firm_matches


def select_weak_pairs(
    plain: Mapping[tuple[int, int], MatchedPair], num_keyframes: int, config: AffineSimulationConfig
) -> set[tuple[int, int]]:
    """The pairs that are worth matching with tilted features, given what the `plain` features say of all pairs.

    Such a pair is not firm, one of its frames has few firm pairs, and the frames may overlap: their plain matches hint
    at it, they have a firm partner in common, or no chain of firm pairs connects them.
    """
    if not config.tilts:
        return set()
    firm = {pair for pair, matched in plain.items() if is_strong_pair(matched.geometry, config)}
    everyone = range(num_keyframes)
    partners = [{i + j - index for i, j in firm if index in (i, j)} for index in everyone]
    components = find_components(everyone, firm)
    component_of = {index: number for number, component in enumerate(components) for index in component}

    def may_overlap(i: int, j: int) -> bool:
        hinted = plain[i, j].log10_nfa < config.hint_log10_nfa
        return hinted or component_of[i] != component_of[j] or not partners[i].isdisjoint(partners[j])

    return {
        (i, j)
        for i, j in plain
        if (i, j) not in firm
        and min(len(partners[i]), len(partners[j])) < config.enough_firm_pairs
        and may_overlap(i, j)
    }
