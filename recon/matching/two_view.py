"""Two-view geometry: do two frames show one rigid scene, does it need parallax, and what is the focal length?"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon import poselib
from splatnode.recon.frames.keyframe import REFERENCE_SIDE

Array = npt.NDArray[np.float64]

_FUNDAMENTAL_SAMPLE = 7  # matches that define a fundamental matrix
_PURE_ROTATION_RATIO = 0.9  # inlier ratio of a pure rotation from which on a pair shows no parallax

# MAGSAC++ for the fundamental matrix: sure and slow, because with few views no pair must be lost to bad luck.
_CONFIDENCE, _MAX_ITERATIONS = 0.9999, 10000
_LOCAL_ITERATIONS, _LOCAL_SAMPLE = 10, 20  # of the local optimisation: rounds, and matches drawn in each
_POLISHER_ITERATIONS = 10  # of the last refinement, in which all inliers count

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
    rotation_focal_ratio: float  # the same if the camera only rotated

    @property
    def is_pure_rotation(self) -> bool:
        """Whether a pure rotation explains nearly all inliers, so that no translation is needed."""
        return self.num_rotation >= _PURE_ROTATION_RATIO * len(self.matches)

    def swap(self) -> TwoView:
        """The geometry with the second frame first."""
        return replace(self, matches=self.matches[:, ::-1], points1=self.points2, points2=self.points1)

    def rescale(self, scale1: float, scale2: float) -> TwoView:
        """The geometry of the same frames resized by these factors."""
        return replace(self, points1=scale1 * self.points1, points2=scale2 * self.points2)


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
    rotation_inliers, rotation_focal = fit_rotation(points1, points2, config.homography_px * scale, longer_side)
    geometry = TwoView(
        matches=matches[inlier],
        points1=points1,
        points2=points2,
        num_candidates=len(matches),
        log10_nfa=log10_nfa,
        num_homography=0 if plane is None else int(plane.sum()),
        num_rotation=rotation_inliers,
        focal_ratio=_estimate_shared_focal(points1, points2, threshold) / longer_side,
        rotation_focal_ratio=rotation_focal / longer_side,
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
