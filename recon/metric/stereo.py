"""The unit by rectified stereo pairs of known baseline: how far the scene's points move between the two pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.lengths import format_length
from splatnode.recon.frames.keyframe import REFERENCE_SIDE
from splatnode.recon.metric.measurement import Measurement
from splatnode.recon.metric.stereo_pairs import StereoPair
from splatnode.recon.metric.views import MetricView, compute_scale_sigma
from splatnode.recon.registration import patch_alignment
from splatnode.recon.result.landmarks import Landmarks

Array = npt.NDArray[np.float64]

_PATCHES = patch_alignment.PatchAlignmentConfig(radius=6)
_LEAST_CORRELATION, _MOST_SIGMA_PX = 0.85, 0.25  # of a patch with what it was aligned to
_MOST_BACK_PX = 0.5  # between a point and where it comes from there and back
_LEAST_POINTS = 30
_MOST_ROWS_PX = 1.0  # median difference of rows: beyond, the pair is not rectified
_SHIFT_SIGMA_PX, _MOST_SIGMAS = 0.1, 4.0  # by which the principal points of a rectified pair differ still
_FREE_PX = 1e3  # where they may differ by anything
_POINTS_AS_ONE = 10.0  # neighbours are wrong alike
_ROUNDS, _HUBER = 10, 1.5  # of the robust fit; standard deviations


@dataclass(frozen=True, eq=False)
class _Disparities:
    """Points that both pictures of a pair show, M of them. Lengths in a picture are rays at depth 1."""

    depths: Array  # (M,) in the scene's unit
    across: Array  # (M,) left less right, along the rows
    down: Array  # (M,) left less right
    px: float  # of the reference size, in rays


def estimate_scale_from_stereo(
    views: Mapping[str, MetricView],
    landmarks: Landmarks | None,
    pairs: Sequence[StereoPair],
    baseline_m: float,
    sigma_m: float,
) -> Measurement | str:
    """The unit, or a sentence why the pairs do not give it.

    `baseline_m` is between the two cameras and `sigma_m` its standard deviation, metres. Rows are compared first.
    Pairs of which there is no view, or which the landmarks do not know, do not count: the scene that is shown and the
    newest estimate, whose landmarks they are, need not have the same cameras.
    """
    name = f"stereo pairs with {format_length(baseline_m)} between the cameras"
    if landmarks is None:
        return f"{name} were given, and the scene has no points to compare with"
    pairs = [each for each in pairs if each.photograph in views and each.photograph in landmarks.names]
    seen = [_measure_disparities(views[each.photograph], landmarks, each) for each in pairs]
    seen = [each for each in seen if len(each.depths)]
    count = sum(len(each.depths) for each in seen)
    if count < _LEAST_POINTS:
        return f"{name} were given, and their pictures share {count} points of the scene; {_LEAST_POINTS} are needed"
    rows_px = float(np.median(np.concatenate([np.abs(each.down / each.px) for each in seen])))
    if rows_px > _MOST_ROWS_PX:
        return f"{name} are not rectified: what both see is {rows_px:.1f} pixels higher in one than in the other"
    across_px = np.concatenate([each.across / each.px for each in seen])
    if np.median(across_px) < 0.0:
        return f"{name} have left and right exchanged: the photographs of the scene must be the left camera's"
    px = np.concatenate([np.full(len(each.depths), each.px) for each in seen])
    nearness = 1.0 / (np.concatenate([each.depths for each in seen]) * px)
    free = _fit_line(nearness, across_px, _FREE_PX)
    if abs(free.shift) > _MOST_SIGMAS * math.hypot(free.shift_sigma, _SHIFT_SIGMA_PX):
        return (
            f"{name} are not rectified: what is far away moves by {free.shift:.1f} pixels between them; the principal "
            "points of both must be the same"
        )
    line = _fit_line(nearness, across_px, _SHIFT_SIGMA_PX)
    of_scene = compute_scale_sigma(list(views.values()))  # all fix the depths of the points, whichever have a partner
    sigma = math.hypot(line.log_sigma, of_scene, sigma_m / baseline_m)
    return Measurement(baseline_m / line.slope, sigma, f"{len(seen)} {name}")


def _measure_disparities(view: MetricView, landmarks: Landmarks, pair: StereoPair) -> _Disparities:
    """The scene's points that the photograph shows, found in its partner to parts of a pixel."""
    height, width = pair.left.shape
    number = landmarks.names.index(pair.photograph)
    points = landmarks.points[np.unique(landmarks.point_of[landmarks.photograph_of == number])]
    depths = ((points - view.centre) @ view.T_world_camera[:3, :3])[:, 2]
    left = view.project(points, width, height)
    margin = _PATCHES.radius + 1.0
    inside = (depths > 0) & (left > margin).all(1) & (left < np.array([width, height]) - margin).all(1)
    left, depths = left[inside], depths[inside]
    right, found = _track_points(pair, left)
    rays = view.unproject(left[found], width, height), view.unproject(right[found], width, height)
    across, down = (rays[0] - rays[1]).T
    return _Disparities(depths[found], across, down, 1.0 / (REFERENCE_SIDE * view.focal))


def _track_points(pair: StereoPair, left: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Pixels (M, 2) in the right picture of pixels in the left one, and which of them were found (M,)."""
    if not len(left):
        return left, np.zeros(0, bool)
    start = np.ascontiguousarray(left - 0.5, np.float32)[:, None]
    there, ahead, _ = cv2.calcOpticalFlowPyrLK(pair.left, pair.right, start, None, winSize=(15, 15), maxLevel=4)  # type: ignore[call-overload]
    back, behind, _ = cv2.calcOpticalFlowPyrLK(pair.right, pair.left, there, None, winSize=(15, 15), maxLevel=4)  # type: ignore[call-overload]
    same = np.linalg.norm((back - start)[:, 0], axis=1) < _MOST_BACK_PX
    first = np.zeros(len(left), np.int64)
    guess = np.asarray(there[:, 0] + 0.5, np.float64)
    patches = patch_alignment.Patches(first, left, first + 1, guess, np.tile(np.eye(2), (len(left), 1, 1)))
    grey = [np.asarray(each, np.float32) for each in (pair.left, pair.right)]
    aligned = patch_alignment.align(grey, patches, _PATCHES)
    good = (aligned.correlation > _LEAST_CORRELATION) & (aligned.sigma < _MOST_SIGMA_PX)
    near = np.linalg.norm(aligned.target - guess, axis=1) < 2.0
    return aligned.target, same & good & near & (ahead.ravel() > 0) & (behind.ravel() > 0)


@dataclass(frozen=True)
class _Line:
    slope: float
    shift: float  # pixels
    log_sigma: float  # standard deviation of the slope's logarithm
    shift_sigma: float  # of the shift, pixels


def _fit_line(nearness: Array, across: Array, held: float) -> _Line:
    """The line of `across` (M,) over `nearness` (M,), robust (Huber's weights).

    The shift is held near 0 with the standard deviation `held`, pixels.
    """
    columns = np.stack([nearness, np.ones_like(nearness)], 1)
    values, covariance = np.array([float(np.median(across / nearness)), 0.0]), np.eye(2)
    for _ in range(_ROUNDS):
        off = np.abs(across - columns @ values)
        noise = max(1.48 * float(np.median(off)), 1e-3)
        weights = np.clip(_HUBER * noise / np.maximum(off, 1e-12), 0.0, 1.0) / noise**2 / _POINTS_AS_ONE
        covariance = np.linalg.inv(columns.T @ (weights[:, None] * columns) + np.diag([0.0, held**-2]))
        values = covariance @ (columns.T @ (weights * across))
    slope, sigmas = float(values[0]), np.sqrt(np.diag(covariance))
    return _Line(slope, float(values[1]), float(sigmas[0]) / abs(slope), float(sigmas[1]))
