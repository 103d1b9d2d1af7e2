"""PoseLib's robust estimators of poses; OpenCV's in its place where it is not installed, as it has no wheel there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from splatnode.recon.geometry import epipolar_errors, project

# PoseLib's estimators by OpenCV's, for systems that PoseLib has no wheel for (Linux on aarch64).
#
# They take and return what PoseLib's do, as far as it is used here. All are deterministic. Registration refines what
# they find, so the answers agree but for what RANSAC leaves to chance.

Array = npt.NDArray[np.float64]
Options = Mapping[str, Any]
_Found = tuple["Pose", dict[str, Any]]

_CONFIDENCE, _MAX_ITERATIONS = 0.9999, 5000
_LOCAL_ITERATIONS, _LOCAL_SAMPLE = 10, 20  # of the local optimisation: rounds, and matches drawn in each
_NO_LIMIT = 1e9  # baselines: a point may be as far away as it likes
_ATTEMPTS = 5  # at a relative pose, with other samples: of few matches or a plane the first may be another's
_MAX_MATCHES = 300  # that a focal length is judged by
# Focal lengths over half the points' extent, from 127 to 17 degrees of view: those that are looked at, and those among
# them from which the search starts whatever the fundamental matrix says (of a plane it says nothing).
_FOCALS = np.geomspace(0.5, 6.6, 60)
_ALWAYS = (15, 30, 45)
_FURTHER = 3  # starts that the fundamental matrix proposes
_MAX_STEPS = 12  # from each start


@dataclass(frozen=True, eq=False)
class Pose:
    """A motion x -> R x + t: from the world, or from the first camera, to the camera."""

    R: Array  # (3, 3)
    t: Array  # (3,)

    @property
    def Rt(self) -> Array:
        """(3, 4)"""
        return np.column_stack([self.R, self.t])


@dataclass(frozen=True)
class _SharedCamera:
    focal_px: float

    def focal(self) -> float:
        return self.focal_px


@dataclass(frozen=True, eq=False)
class ImagePair:
    pose: Pose
    camera1: _SharedCamera  # of both images


_NOTHING = Pose(np.eye(3), np.zeros(3))


def estimate_opencv_absolute_pose(
    pixels: Array, points: Array, camera: Options, options: Options, refinement: Options | None = None
) -> _Found:
    """The pose from pixels (M, 2) of world points (M, 3), and `inliers`, M booleans; none where there is no pose.

    `refinement` is not looked at: the inliers' squared errors are minimised.
    """
    limit = options["max_reproj_error"]
    K = _matrix(camera)
    nothing = _NOTHING, {"inliers": [False] * len(pixels)}
    if len(pixels) < 4:
        return nothing
    found, _, rotation, translation, _ = cv2.solvePnPRansac(
        np.ascontiguousarray(points), np.ascontiguousarray(pixels), K, None, params=_usac(limit)
    )
    if not found:
        return nothing
    pose, inliers = _absolute(rotation, translation), np.zeros(len(pixels), bool)
    for _ in range(2):
        in_camera = points @ pose.R.T + pose.t
        inliers = (np.linalg.norm(project(in_camera, K) - pixels, axis=1) < limit) & (in_camera[:, 2] > 0)
        if inliers.sum() < 4:
            break
        chosen = np.ascontiguousarray(points[inliers]), np.ascontiguousarray(pixels[inliers])
        pose = _absolute(*cv2.solvePnPRefineLM(*chosen, K, None, cv2.Rodrigues(pose.R)[0], pose.t.copy()))
    return pose, {"inliers": inliers.tolist()}


def estimate_opencv_relative_pose(
    pixels1: Array, pixels2: Array, camera1: Options, camera2: Options, options: Options
) -> _Found:
    """The second camera's pose in the first one's frame, of unit length, from matched pixels (M, 2), and `inliers`."""
    K1, K2 = _matrix(camera1), _matrix(camera2)
    rays1, rays2 = (np.linalg.solve(K, _homogeneous(p).T).T[:, :2] for K, p in ((K1, pixels1), (K2, pixels2)))
    focal = float(np.sqrt(K1[0, 0] * K2[0, 0]))
    limit = options["max_epipolar_error"] / focal
    best, least = (_NOTHING, np.zeros(len(pixels1), bool)), np.inf
    for state in range(_ATTEMPTS):
        pose, inliers = _five_point(rays1, rays2, limit, state)
        if inliers.any():
            (pose, _), _ = _refine_pose(pose, 1.0, rays1[inliers], rays2[inliers], limit, free_focal=False)
        found = np.minimum(_errors_in_front(pose, rays1, rays2) / limit, 1)
        if (cost := float((found**2).sum())) < least:
            best, least = (pose, found < 1), cost
    return best[0], {"inliers": best[1].tolist()}


def estimate_opencv_shared_focal_relative_pose(
    pixels1: Array, pixels2: Array, principal: Array, options: Options
) -> tuple[ImagePair, dict[str, Any]]:
    """Pose and focal length, equal in both images, from matched pixels (M, 2); the principal point (2,) is given.

    Pose and focal length minimise the Sampson errors, cut off softly, from several starts: where the fundamental matrix
    comes nearest to an essential one (Mendonca and Cipolla 1999), and some that do not depend on it.
    """
    limit = options["max_epipolar_error"]
    centred1, centred2 = pixels1 - principal, pixels2 - principal
    extent = float(max(np.abs(centred1).max(), np.abs(centred2).max(), 1.0))
    some = slice(None, None, 1 + len(pixels1) // _MAX_MATCHES)

    best, least = (_NOTHING, extent), np.inf
    for focal in _starts(centred1, centred2, extent * _FOCALS):
        start, inliers = _five_point(centred1 / focal, centred2 / focal, limit / focal)
        if not inliers.any():
            continue
        found, cost = _refine_pose(start, focal, centred1[some], centred2[some], limit, free_focal=True)
        if cost < least:
            best, least = found, cost
    pose, focal = best
    inliers = _sampson(pose, centred1 / focal, centred2 / focal) < limit / focal
    return ImagePair(pose, _SharedCamera(focal)), {"inliers": inliers.tolist()}


def _refine_pose(
    start: Pose, focal: float, pixels1: Array, pixels2: Array, limit: float, *, free_focal: bool
) -> tuple[tuple[Pose, float], float]:
    """Pose and focal length that minimise the Sampson errors of pixels (M, 2), cut off softly, and that minimum."""

    def apply_step(parameters: Array) -> tuple[Pose, float]:
        turn = np.asarray(cv2.Rodrigues(parameters[:3])[0], np.float64)
        direction = start.t + parameters[3:6]
        length = focal * float(np.exp(parameters[6])) if free_focal else focal
        return Pose(turn @ start.R, direction / np.linalg.norm(direction)), length

    def errors(parameters: Array) -> Array:
        pose, length = apply_step(parameters)
        return _sampson(pose, pixels1 / length, pixels2 / length) * length / limit

    found = least_squares(errors, np.zeros(7 if free_focal else 6), loss="soft_l1", max_nfev=_MAX_STEPS)
    return apply_step(found.x), float(found.cost)


def _starts(centred1: Array, centred2: Array, focals: Array) -> Array:
    """The focal lengths among `focals` (L,) from which a search should start."""
    fundamental, _ = cv2.findFundamentalMat(centred1, centred2, cv2.FM_8POINT)
    chosen = set(_ALWAYS)
    if fundamental is not None:
        scale = np.ones((len(focals), 3))
        scale[:, :2] = focals[:, None]
        values = np.linalg.svd(scale[:, :, None] * fundamental[:3] * scale[:, None, :], compute_uv=False)
        unlike = np.pad(1 - values[:, 1] / values[:, 0], 1, constant_values=np.inf)  # 0 of an essential matrix
        lowest = np.flatnonzero((unlike[1:-1] <= unlike[:-2]) & (unlike[1:-1] <= unlike[2:]))
        chosen |= set(lowest[np.argsort(unlike[1:-1][lowest])][:_FURTHER].tolist())
    return focals[sorted(chosen)]


def _five_point(rays1: Array, rays2: Array, limit: float, state: int = 0) -> tuple[Pose, npt.NDArray[np.bool_]]:
    """The relative pose from rays (M, 2) at depth 1, and its inliers (M,); none where no pose is found.

    Another `state` of the random generator draws other samples.
    """
    nothing = _NOTHING, np.zeros(len(rays1), bool)
    if len(rays1) < 5:
        return nothing
    rays1, rays2, identity = np.ascontiguousarray(rays1), np.ascontiguousarray(rays2), np.eye(3)
    essential, _ = cv2.findEssentialMat(rays1, rays2, identity, identity, None, None, _usac(limit, state))
    if essential is None or essential.shape != (3, 3):
        return nothing
    rotation, translation = cv2.recoverPose(essential, rays1, rays2, identity, _NO_LIMIT)[1:3]
    pose = Pose(np.asarray(rotation, np.float64), np.asarray(translation, np.float64).ravel())
    return pose, _sampson(pose, rays1, rays2) < limit


def _sampson(pose: Pose, rays1: Array, rays2: Array) -> Array:
    """(M,) Sampson errors at depth 1."""
    x, y, z = pose.t
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose.R
    return np.abs(epipolar_errors(essential, rays1, rays2))


def _errors_in_front(pose: Pose, rays1: Array, rays2: Array) -> Array:
    """(M,) Sampson errors at depth 1; infinite where the rays meet behind a camera."""
    turned, second = _homogeneous(rays1) @ pose.R.T, _homogeneous(rays2)
    normal = np.cross(second, turned)
    depth1, depth2 = (-(normal * np.cross(each, pose.t)).sum(1) for each in (second, turned))
    return np.where((depth1 > 0) & (depth2 > 0), _sampson(pose, rays1, rays2), np.inf)


def _usac(limit: float, state: int = 0) -> cv2.UsacParams:
    params = cv2.UsacParams()
    params.randomGeneratorState = state
    params.threshold, params.confidence, params.maxIterations = limit, _CONFIDENCE, _MAX_ITERATIONS
    params.sampler, params.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    params.loIterations, params.loSampleSize = _LOCAL_ITERATIONS, _LOCAL_SAMPLE
    return params


def _absolute(rotation_vector: Any, translation: Any) -> Pose:
    return Pose(np.asarray(cv2.Rodrigues(rotation_vector)[0], np.float64), np.asarray(translation, np.float64).ravel())


def _homogeneous(points: Array) -> Array:
    return np.column_stack([points, np.ones(len(points))])


def _matrix(camera: Options) -> Array:
    """(3, 3) intrinsics of PoseLib's models SIMPLE_PINHOLE (f, cx, cy) and PINHOLE (fx, fy, cx, cy)."""
    params: Sequence[float] = camera["params"]
    fx, fy, cx, cy = params if len(params) == 4 else (params[0], *params)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


try:
    from poselib import (  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]
        estimate_absolute_pose,
        estimate_relative_pose,
        estimate_shared_focal_relative_pose,
    )
except ImportError:
    estimate_absolute_pose = estimate_opencv_absolute_pose
    estimate_relative_pose = estimate_opencv_relative_pose
    estimate_shared_focal_relative_pose = estimate_opencv_shared_focal_relative_pose
