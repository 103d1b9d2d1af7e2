"""What two frames say about each other: is there a common rigid scene, is there parallax, what is the focal length?"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import poselib

Array = npt.NDArray[np.float64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    epipolar_px: float = 1.5  # inlier threshold, pixels at 1024 on the longer side
    homography_px: float = 2.5
    max_log10_nfa: float = -12.0  # at most this chance (log10) that unrelated images agree as well
    min_inliers: int = 20


@dataclass(frozen=True, eq=False)
class TwoView:
    """A verified pair of frames. `points1[k]` and `points2[k]` are the pixels of one inlier match,
    relative to the principal points, each of its own frame."""

    matches: npt.NDArray[np.int64]  # (M, 2) feature indices of the inliers
    points1: Array  # (M, 2)
    points2: Array  # (M, 2)
    num_candidates: int  # matches before the epipolar geometry was known
    log10_nfa: float  # log10 of the expected number of such agreements between unrelated images
    num_homography: int  # inliers that one homography explains too: a plane, or no parallax
    num_rotation: int  # inliers that a rotation of a camera with one focal length explains: no parallax
    focal_ratio: float  # shared focal length over the longer side, from this pair alone
    rotation_focal_ratio: float  # the same under the assumption that the camera only turned

    @property
    def turned_only(self) -> bool:
        """Nothing in this pair needs the camera to have moved."""
        return self.num_rotation >= 0.9 * len(self.matches)

    def swapped(self) -> TwoView:
        """The same of the second frame and the first."""
        return replace(self, matches=self.matches[:, ::-1], points1=self.points2, points2=self.points1)

    def enlarged(self, by1: float, by2: float) -> TwoView:
        """The same of frames that are larger by these factors."""
        return replace(self, points1=by1 * self.points1, points2=by2 * self.points2)


def examine(
    points1: Array, points2: Array, matches: npt.NDArray[np.int64], size: tuple[int, int], config: Config
) -> tuple[TwoView | None, float]:
    """The pair's geometry, or None when chance explains the agreement of `points1` and `points2` (both (M, 2)).

    With it, also where it is None, log10 of the expected number of false alarms.
    The most distinct matches come first. Pixels are relative to the principal points; `size` is the second image's
    (width, height). The test is a contrario (Moisan and Stival, 2004): the expected number of fundamental matrices,
    among all that the matches define, that as many unrelated points would fit within the threshold.
    """
    longer_side = max(size)
    scale = longer_side / 1024.0
    if len(matches) < config.min_inliers:
        return None, 0.0
    threshold = config.epipolar_px * scale
    fundamental, mask = cv2.findFundamentalMat(points1, points2, _magsac(threshold))
    if fundamental is None or mask is None:
        return None, 0.0
    inlier = mask.ravel() > 0
    # An unrelated point falls into the band around its epipolar line with this probability.
    chance = min(1.0, 2.0 * threshold * float(np.hypot(*size)) / (size[0] * size[1]))
    log10_nfa = log10_number_of_false_alarms(len(matches), int(inlier.sum()), sample_size=7, chance=chance)
    if inlier.sum() < config.min_inliers or log10_nfa > config.max_log10_nfa:
        return None, log10_nfa
    points1, points2 = points1[inlier], points2[inlier]
    _, plane = cv2.findHomography(points1, points2, cv2.USAC_MAGSAC, config.homography_px * scale)
    rotation_inliers, rotation_focal = fit_rotation(points1, points2, config.homography_px * scale, longer_side)
    found = TwoView(
        matches=matches[inlier],
        points1=points1,
        points2=points2,
        num_candidates=len(matches),
        log10_nfa=log10_nfa,
        num_homography=0 if plane is None else int(plane.sum()),
        num_rotation=rotation_inliers,
        focal_ratio=_shared_focal(points1, points2, threshold) / longer_side,
        rotation_focal_ratio=rotation_focal / longer_side,
    )
    return found, log10_nfa


def _magsac(threshold: float) -> cv2.UsacParams:
    """MAGSAC++ (Barath et al., 2020) that draws its samples from the most distinct matches first (PROSAC)."""
    params = cv2.UsacParams()
    params.threshold, params.confidence, params.maxIterations = threshold, 0.9999, 10000
    params.sampler, params.score = cv2.SAMPLING_PROSAC, cv2.SCORE_METHOD_MAGSAC
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_SIGMA, 10, 20
    params.final_polisher, params.final_polisher_iterations = cv2.MAGSAC, 10
    return params


def log10_number_of_false_alarms(num_matches: int, num_inliers: int, sample_size: int, chance: float) -> float:
    """log10 of (n - s) * C(n, k) * C(k, s) * chance^(k - s)."""
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
    """How many matches (centred pixels) a pure rotation explains, and with which focal length in pixels.

    One focal length after the other is tried, coarsely with some of the matches, then around the best with all.
    """
    focals = longer_side * np.geomspace(0.35, 4.0, 49)
    some = slice(None, None, 1 + len(points1) // 300)
    counts = [_turned(points1[some], points2[some], focal, threshold) for focal in focals[::3]]
    middle = 3 * int(np.argmax(counts))
    near = focals[max(0, middle - 2) : middle + 3]
    counts = [_turned(points1, points2, focal, threshold) for focal in near]
    return max(counts), float(near[int(np.argmax(counts))])


def _turned(points1: Array, points2: Array, focal: float, threshold: float) -> int:
    """How many matches a rotation of a camera with this focal length explains.

    The rotation has a closed form (Kabsch, 1976), which is refitted to the matches that agree until these stay.
    """
    rays1, rays2 = _unit_rays(points1, focal), _unit_rays(points2, focal)
    inlier, error = np.ones(len(points1), bool), np.zeros(len(points1))
    for _ in range(6):
        u, _, vt = np.linalg.svd(rays2[inlier].T @ rays1[inlier])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turned = rays1 @ rotation.T
        error = np.linalg.norm(turned[:, :2] / np.maximum(turned[:, 2:], 1e-3) * focal - points2, axis=1)
        # The first fits are to all matches: their threshold starts wide and closes.
        agreed = error < max(threshold, float(np.quantile(error, 0.7)) if inlier.all() else threshold)
        if agreed.sum() < 8 or (agreed == inlier).all():
            break
        inlier = agreed
    return int(np.count_nonzero(error < threshold))


def _unit_rays(points: Array, focal: float) -> Array:
    rays = np.column_stack([points / focal, np.ones(len(points))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _shared_focal(points1: Array, points2: Array, threshold: float) -> float:
    """The focal length in pixels, equal in both views, that the six-point solver finds (Kukelova et al., 2008)."""
    pair, _ = poselib.estimate_shared_focal_relative_pose(
        points1,
        points2,
        np.zeros(2),
        {"max_epipolar_error": threshold, "min_iterations": 200, "max_iterations": 2000, "seed": 0},
    )
    return float(pair.camera1.focal())
