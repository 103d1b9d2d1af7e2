"""Epipolar geometry of a pair whose focal lengths are known: relative pose, and the Sampson errors of matches."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from splatnode.recon import poselib
from splatnode.recon.core import library, pointer
from splatnode.recon.geometry import undistort_iterations
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment

Array = npt.NDArray[np.float64]

_MIN_PARALLAX_PX = 5.0  # below it, the noise of a match decides whether its point lies in front of the cameras
_ITERATIONS = {"min_iterations": 100, "max_iterations": 5000, "seed": 0}  # of RANSAC: 5000 do for 25 % inliers


def relative_pose(pair: TwoView, focal1: float, focal2: float, max_error_px: float) -> tuple[Array, Array, int]:
    """Pose of the second camera in the frame of the first, and the number of inliers, from five points (poselib).

    The rotation is (3, 3), from the first camera's axes to the second's; the translation (3,) has unknown length.
    `focal1`, `focal2` and `max_error_px` (Sampson) are in pixels.
    """
    pose, info = poselib.estimate_relative_pose(
        pair.points1,
        pair.points2,
        pinhole(focal1),
        pinhole(focal2),
        {"max_epipolar_error": max_error_px, **_ITERATIONS},
    )
    return np.asarray(pose.R), np.asarray(pose.t), int(sum(info["inliers"]))


def sampson_errors(estimate: bundle_adjustment.Problem, views: tuple[int, int], pair: TwoView) -> Array:
    """(M,) Sampson errors of the matches of `pair` under the estimated poses of its two views, pixels.

    Infinite where a match's point lies behind a camera (Hartley and Zisserman, 2004, 11.4.3 for the error).
    """
    first, second = views
    rotation = estimate.rotations[second] @ estimate.rotations[first].T
    lenses = estimate.lens_of_camera[list(views)]
    across, radials = np.exp(estimate.log_focals[lenses]), estimate.radials[lenses]
    focals = np.stack([across, across * estimate.aspects[lenses]], 1)
    pose = _Pose(
        tuple(rotation.ravel()),
        tuple(estimate.translations[second] - rotation @ estimate.translations[first]),
        tuple(focals.ravel()),
        tuple(radials.ravel()),
        tuple(estimate.shifts[lenses].ravel()),
        _MIN_PARALLAX_PX / focals.max(),
        undistort_iterations(radials),
    )
    points1, points2 = (np.ascontiguousarray(points, np.float64) for points in (pair.points1, pair.points2))
    errors = np.empty(len(points1))
    native = ctypes.byref(pose), pointer(points1), pointer(points2), len(points1), pointer(errors)
    library().core_sampson_errors(*native)
    return errors


class _Pose(ctypes.Structure):
    """`EpipolarPose` of recon/core/epipolar.cpp."""

    _fields_ = (
        ("rotation", ctypes.c_double * 9),
        ("translation", ctypes.c_double * 3),
        ("focals", ctypes.c_double * 4),
        ("radials", ctypes.c_double * 4),
        ("shifts", ctypes.c_double * 4),
        ("min_parallax", ctypes.c_double),
        ("undistort_iterations", ctypes.c_int32),
    )


def pinhole(focal: float) -> dict[str, object]:
    """PoseLib's camera for pixels relative to the principal point; it does not read width and height."""
    return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal, 0, 0]}
