"""Matching of two keyframes: descriptor matches, the two-view geometry that verifies them, and which pairs are tried.

Two-view geometry answers: do two frames show one rigid scene, does it need parallax, and what is the focal length?

Up to `exhaustive` keyframes all pairs are tried. Of more, each is matched with its likeliest partners, so that the work
grows with the keyframes and not with their pairs: by the codes of their images a short list, of which those count that
have most matches among their strongest features, "at a glance". Where a keyframe does not become firmly connected with
the others, further partners follow, in the end all.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.system import raise_shortage
from splatnode.recon import poselib
from splatnode.recon.geometry import epipolar_errors
from splatnode.recon.keyframes import (
    LIBRARY_ERRORS,
    PLAIN,
    REFERENCE_SIDE,
    Features,
    Keyframe,
    longer_side,
    principal_point,
)
from splatnode.recon.matching import features as matching_features
from splatnode.recon.matching.features import Code, describe, similarities

Array = npt.NDArray[np.float64]

_FUNDAMENTAL_SAMPLE = 7  # matches that define a fundamental matrix
_PURE_ROTATION_RATIO = 0.9  # inlier ratio of a pure rotation from which on a pair shows no parallax

# MAGSAC++ for the fundamental matrix: sure and slow, because with few views no pair must be lost to bad luck.
_CONFIDENCE, _MAX_ITERATIONS = 0.9999, 10000
_LOCAL_ITERATIONS, _LOCAL_SAMPLE = 10, 20  # of the local optimisation: rounds, and matches drawn in each
_POLISHER_ITERATIONS = 10  # of the last refinement, in which all inliers count

_FUNDAMENTAL_REFITS = 5  # by least squares, each to the matches that the matrix before explains

# RANSAC for the shared focal length: its matches are inliers already, so that few iterations are enough.
_FOCAL_ITERATIONS = {"min_iterations": 200, "max_iterations": 2000, "seed": 0}

# Pure rotation: focal lengths over the longer side that are tried, 110 to 14 degrees of view in steps of 5 %.
_ROTATION_FOCALS = np.geomspace(0.35, 4.0, 49)
_COARSE_STEP = 3  # focal lengths from one to the next in the first, coarse search
_COARSE_MATCHES = 300  # at about so many matches the coarse search is sure enough
_ROTATION_REFITS = 6  # at most; the inliers have settled by then
_MIN_ROTATION_INLIERS = 8  # for a refit: fewer say little about a rotation
_FIRST_QUANTILE = 0.7  # of the errors of the fit to all matches: its threshold is at least this wide
_MIN_DEPTH = 1e-3  # of a turned unit ray: what is beside or behind the camera projects far outside the image


class TwoViewConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    epipolar_px: float = 1.5  # inlier threshold of the fundamental matrix, pixels at REFERENCE_SIDE
    homography_px: float = 2.5  # inlier threshold of a homography and of a pure rotation, pixels at REFERENCE_SIDE
    # Log10 of the largest number of false alarms of a verified pair: unrelated images agree no more often
    max_log10_nfa: float = -12.0
    min_inliers: int = 20  # matches that a geometry must explain


@dataclass(frozen=True, eq=False)
class TwoView:
    """The geometry of a verified pair. `points1[k]` and `points2[k]` are the pixels of inlier match k,
    relative to the principal point, each of its own frame."""

    matches: npt.NDArray[np.int64]  # (M, 2) point numbers of the inliers
    points1: Array  # (M, 2)
    points2: Array  # (M, 2)
    num_candidates: int  # matches before the epipolar geometry was known
    log10_nfa: float  # log10 of the expected number of such agreements between unrelated images
    num_homography: int  # inliers that one homography explains too: a plane, or no parallax
    num_rotation: int  # inliers that a pure rotation with one focal length explains: no parallax
    focal_ratio: float  # shared focal length over the longer side, from this pair alone

    @property
    def is_pure_rotation(self) -> bool:
        """Whether a pure rotation explains nearly all inliers, so that no translation is needed."""
        return self.num_rotation >= _PURE_ROTATION_RATIO * len(self.matches)

    def swap(self) -> TwoView:
        """The geometry with the second frame first."""
        return replace(self, matches=self.matches[:, ::-1], points1=self.points2, points2=self.points1)

    def select(self, chosen: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> TwoView:
        """The same geometry with some of its matches, by their positions or a mask (M,)."""
        return replace(self, matches=self.matches[chosen], points1=self.points1[chosen], points2=self.points2[chosen])

    def rescale(self, scale1: float, scale2: float) -> TwoView:
        """The geometry of the same frames resized by these factors."""
        return replace(self, points1=scale1 * self.points1, points2=scale2 * self.points2)


def fit_epipolar_errors(pair: TwoView, zero_px: float) -> Array:
    """(M,) sizes of the matches' Sampson errors under the fundamental matrix that fits them best, whatever the lenses.

    `zero_px`, in the matches' pixels, is the error from which on a match does not count. Infinite where none fits.
    """
    matrix, _ = cv2.findFundamentalMat(pair.points1, pair.points2, cv2.FM_LMEDS)
    best = np.full(len(pair.matches), np.inf)
    for _ in range(_FUNDAMENTAL_REFITS):
        if matrix is None or matrix.shape != (3, 3):
            break
        errors = np.abs(epipolar_errors(np.asarray(matrix, np.float64), pair.points1, pair.points2))
        if count_explained(errors, zero_px) <= count_explained(best, zero_px):
            break
        best, near = errors, errors < zero_px
        matrix, _ = cv2.findFundamentalMat(pair.points1[near], pair.points2[near], cv2.FM_8POINT)
    return best


def count_explained(errors: Array, zero_px: float) -> float:
    """The number of matches with these errors that are explained; one with error e counts 1 - (e / zero_px)^2."""
    return float(np.maximum(0.0, 1.0 - (errors / zero_px) ** 2).sum())


def motion_px(points1: Array, points2: Array, longer_side: int) -> Array:
    """(M,) distances from `points1` to `points2` (both (M, 2), in images of that longer side), at REFERENCE_SIDE."""
    return np.linalg.norm(points2 - points1, axis=1) * REFERENCE_SIDE / longer_side


def estimate(
    points1: Array, points2: Array, matches: npt.NDArray[np.int64], size: tuple[int, int], config: TwoViewConfig
) -> tuple[TwoView | None, float]:
    """The pair's geometry, or None when chance explains the agreement, and log10 of the number of false alarms.

    `points1` and `points2` (both (M, 2)) are the pixels of the `matches` (M, 2), relative to the principal points, the
    most distinct match first; `size` is the second image's (width, height).

    The test is a contrario (Moisan and Stival, 2004): the number of false alarms is the expected number of fundamental
    matrices, among all that the matches define, that as many unrelated points would fit within the threshold.
    """
    longer_side = max(size)
    scale = longer_side / REFERENCE_SIDE
    if len(matches) < config.min_inliers:
        return None, 0.0
    threshold = config.epipolar_px * scale
    fundamental, mask = cv2.findFundamentalMat(points1, points2, _magsac(threshold))
    if fundamental is None or mask is None:
        return None, 0.0
    inlier = mask.ravel() > 0
    # The probability that an unrelated point falls into the band around its epipolar line.
    chance = min(1.0, 2.0 * threshold * float(np.hypot(*size)) / (size[0] * size[1]))
    log10_nfa = log10_number_of_false_alarms(len(matches), int(inlier.sum()), _FUNDAMENTAL_SAMPLE, chance)
    if inlier.sum() < config.min_inliers or log10_nfa > config.max_log10_nfa:
        return None, log10_nfa
    points1, points2 = points1[inlier], points2[inlier]
    _, plane = cv2.findHomography(points1, points2, cv2.USAC_MAGSAC, config.homography_px * scale)
    rotation_inliers, _ = fit_rotation(points1, points2, config.homography_px * scale, longer_side)
    geometry = TwoView(
        matches=matches[inlier],
        points1=points1,
        points2=points2,
        num_candidates=len(matches),
        log10_nfa=log10_nfa,
        num_homography=0 if plane is None else int(plane.sum()),
        num_rotation=rotation_inliers,
        focal_ratio=_estimate_shared_focal(points1, points2, threshold) / longer_side,
    )
    return geometry, log10_nfa


def _magsac(threshold: float) -> cv2.UsacParams:
    """MAGSAC++ (Barath et al., 2020) that draws its samples from the most distinct matches first (PROSAC)."""
    params = cv2.UsacParams()
    params.threshold, params.confidence, params.maxIterations = threshold, _CONFIDENCE, _MAX_ITERATIONS
    params.sampler, params.score = cv2.SAMPLING_PROSAC, cv2.SCORE_METHOD_MAGSAC
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_SIGMA, _LOCAL_ITERATIONS, _LOCAL_SAMPLE
    params.final_polisher, params.final_polisher_iterations = cv2.MAGSAC, _POLISHER_ITERATIONS
    return params


def log10_number_of_false_alarms(num_matches: int, num_inliers: int, sample_size: int, chance: float) -> float:
    """log10 of (n - s) * C(n, k) * C(k, s) * chance^(k - s), for n matches, k inliers and samples of s."""
    if num_inliers <= sample_size:
        return 0.0

    def log10_choose(n: int, k: int) -> float:
        return (math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)) / math.log(10)

    return (
        math.log10(num_matches - sample_size)
        + log10_choose(num_matches, num_inliers)
        + log10_choose(num_inliers, sample_size)
        + (num_inliers - sample_size) * math.log10(chance)
    )


def fit_rotation(points1: Array, points2: Array, threshold: float, longer_side: int) -> tuple[int, float]:
    """The number of matches that a pure rotation explains within `threshold`, and its focal length; all in pixels.

    `points1` and `points2` (both (M, 2)) are relative to the principal points. Focal lengths are tried one after the
    other, coarsely with some of the matches, then around the best one with all.
    """
    focals = longer_side * _ROTATION_FOCALS
    some = slice(None, None, 1 + len(points1) // _COARSE_MATCHES)
    counts = _rotation_inliers(points1[some], points2[some], focals[::_COARSE_STEP], threshold)
    best = _COARSE_STEP * int(np.argmax(counts))
    near = focals[max(0, best - _COARSE_STEP + 1) : best + _COARSE_STEP]
    counts = _rotation_inliers(points1, points2, near, threshold)
    return int(counts.max()), float(near[int(np.argmax(counts))])


def _rotation_inliers(points1: Array, points2: Array, focals: Array, threshold: float) -> npt.NDArray[np.int64]:
    """(F,) how many matches the best rotation explains, for each of the `focals` (F,).

    The rotation has a closed form (Kabsch, 1976); it is refitted to its inliers until they stay the same.
    """
    rays1, rays2 = _unit_rays(points1, focals), _unit_rays(points2, focals)
    inlier, error = np.ones(rays1.shape[:2], bool), np.zeros(rays1.shape[:2])
    unsettled = np.arange(len(focals))
    for _ in range(_ROTATION_REFITS):
        before, ours = inlier[unsettled], rays1[unsettled]
        u, _, vt = np.linalg.svd((rays2[unsettled] * before[..., None]).swapaxes(1, 2) @ ours)
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
        turned = ours @ (u @ vt).swapaxes(1, 2)
        projected = turned[..., :2] / np.maximum(turned[..., 2:], _MIN_DEPTH) * focals[unsettled, None, None]
        errors = np.linalg.norm(projected - points2, axis=2)
        error[unsettled] = errors
        # A fit to all matches is spoiled by outliers: its threshold is wide, later ones are not.
        widest = np.where(before.all(1), np.quantile(errors, _FIRST_QUANTILE, axis=1), threshold)
        agreed = errors < np.maximum(threshold, widest)[:, None]
        settled = (agreed.sum(1) < _MIN_ROTATION_INLIERS) | (agreed == before).all(1)
        inlier[unsettled] = agreed
        unsettled = unsettled[~settled]
        if not len(unsettled):
            break
    return np.count_nonzero(error < threshold, axis=1)


def _unit_rays(points: Array, focals: Array) -> Array:
    """(F, M, 3) directions of the pixels `points` (M, 2) for each focal length."""
    rays = np.concatenate([points / focals[:, None, None], np.ones((len(focals), len(points), 1))], axis=2)
    return rays / np.linalg.norm(rays, axis=2, keepdims=True)


def _estimate_shared_focal(points1: Array, points2: Array, threshold: float) -> float:
    """The focal length in pixels, equal in both views, that the six-point solver finds (Kukelova et al., 2008)."""
    pair, _ = poselib.estimate_shared_focal_relative_pose(
        points1, points2, np.zeros(2), {"max_epipolar_error": threshold, **_FOCAL_ITERATIONS}
    )
    return float(pair.camera1.focal())


# Connected components of a graph of frames.


def find_components(nodes: Iterable[int], edges: Iterable[tuple[int, int]]) -> list[list[int]]:
    """The connected components of the undirected graph, the largest first; equally large ones by their first nodes."""
    label = {node: node for node in nodes}
    for i, j in edges:
        old, new = max(label[i], label[j]), min(label[i], label[j])
        label = {node: new if name == old else name for node, name in label.items()}
    groups = [[node for node, name in label.items() if name == group] for group in sorted(set(label.values()))]
    return sorted(groups, key=lambda group: (-len(group), group))


Pair = tuple[int, int]


class PairSelectionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which pairs of keyframes are worth matching, so that the work grows with the keyframes and not with their
    pairs."""

    exhaustive: int = 12  # keyframes up to which all pairs are matched
    partners: int = 8  # with which a keyframe is matched first: with 8 of 29, real sets were as exact as with all
    short_list: int = 24  # keyframes with similar codes that are matched at a glance, to choose the partners
    glance_features: int = 500  # the strongest of each, for that; 1000 chose no better partners
    enough_firm: int = 3  # partners with firm matches that make a keyframe firmly connected


def select_short_list_pairs(codes: Sequence[Code], config: PairSelectionConfig) -> set[Pair]:
    """The pairs (i < j) of which either keyframe has the other on its short list."""
    if len(codes) <= config.exhaustive:
        return set()
    if len(codes) - 1 <= config.short_list:
        return set(itertools.combinations(range(len(codes)), 2))
    alike = similarities(codes)
    return _union([_best(alike[index], index)[: config.short_list] for index in range(len(codes))])


def select_pairs_worth_matching(
    num_keyframes: int,
    glanced: Mapping[Pair, int],
    is_known: Callable[[Pair], bool],
    is_firm: Callable[[Pair], bool],
    config: PairSelectionConfig,
) -> set[Pair]:
    """The pairs (i < j) that are to be matched, as far as that can be said from those that are.

    `glanced` has the number of matches of pairs at a glance. Once all pairs of the answer are known, it is the same
    whatever the order in which the keyframes came.
    """
    everyone = range(num_keyframes)
    if num_keyframes <= config.exhaustive:
        return set(itertools.combinations(everyone, 2))
    likeness = np.full((num_keyframes, num_keyframes), -1)
    for (i, j), count in glanced.items():
        likeness[i, j] = likeness[j, i] = count
    ranked = [_best(likeness[index], index) for index in everyone]
    depth = [config.partners] * num_keyframes
    while True:
        chosen = _union([ranked[index][: depth[index]] for index in everyone])
        if not all(map(is_known, chosen)):
            return chosen
        loose = _find_weakly_connected(everyone, set(filter(is_firm, chosen)), config)
        loose = [index for index in loose if depth[index] < num_keyframes]
        if not loose:
            return chosen
        for index in loose:
            depth[index] += config.partners


def _best(scores: npt.NDArray[Any], index: int) -> list[int]:
    """The other keyframes, that with the highest score first."""
    order = np.argsort(-scores, kind="stable").tolist()
    return [other for other in order if other != index]


def _union(partners: Sequence[Sequence[int]]) -> set[Pair]:
    return {(min(index, other), max(index, other)) for index, those in enumerate(partners) for other in those}


def _find_weakly_connected(everyone: Collection[int], firm: Collection[Pair], config: PairSelectionConfig) -> list[int]:
    """The keyframes with few firm partners, or outside of the largest group that firm pairs connect."""
    (largest, *_) = find_components(everyone, firm)
    counts = np.bincount(np.array(sorted(firm), np.int64).ravel(), minlength=len(everyone))
    return [index for index in everyone if counts[index] < config.enough_firm or index not in largest]


# Appearance check of matches that a prior proposes: the matched points must look alike.
#
# A network may invent matches between unrelated images whose geometry is consistent. Invented matches look no more
# alike than points 16 px away from them.

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
    two_view: TwoViewConfig = TwoViewConfig()
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
    return float(np.median(motion_px(scaled.points1, scaled.points2, longer_side2)))


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
    geometry, log10_nfa = estimate(points1, points2, matches, size, config.two_view)
    if geometry is not None and median_motion_px(geometry, side, side) < config.max_static_px:
        # Static matches may show the robot's own body: the geometry is estimated again from the moving ones alone.
        (moving,) = np.nonzero(motion_px(points1, points2, side) >= config.max_static_px)
        if len(moving) >= config.min_moving:
            again = estimate(points1[moving], points2[moving], matches[moving], size, config.two_view)
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
