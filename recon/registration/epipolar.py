"""Epipolar geometry of a pair whose focal lengths are known: relative pose, and the Sampson errors of matches."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon import poselib
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import bundle
from splatnode.recon.registration.cross_product import cross, cross_matrix

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


def sampson_errors(estimate: bundle.Problem, views: tuple[int, int], pair: TwoView) -> Array:
    """(M,) Sampson errors of the matches of `pair` under the estimated poses of its two views, pixels.

    Infinite where a match's point lies behind a camera (Hartley and Zisserman, 2004, 11.4.3 for the error).
    """
    rays = []
    for view, points in zip(views, (pair.points1, pair.points2), strict=True):
        normalised = bundle.normalise(estimate, np.full(len(points), view), points)
        rays.append(np.column_stack([normalised, np.ones(len(points))]))
    rotation = estimate.rotations[views[1]] @ estimate.rotations[views[0]].T
    translation = estimate.translations[views[1]] - rotation @ estimate.translations[views[0]]
    essential = cross_matrix(translation[None])[0] @ rotation
    line2, line1 = rays[0] @ essential.T, rays[1] @ essential
    residual = np.abs((rays[1] * line2).sum(1))
    focal1, focal2 = np.exp(estimate.log_focals[estimate.lens_of_camera[list(views)]])
    gradient = (line2[:, :2] ** 2).sum(1) / focal2**2 + (line1[:, :2] ** 2).sum(1) / focal1**2
    errors = residual / np.sqrt(np.maximum(gradient, 1e-30))
    # Depths along both rays where they come closest: depth1 * R ray1 + t = depth2 * ray2, up to a positive factor.
    turned = rays[0] @ rotation.T
    normal = cross(rays[1], turned)
    parallax = np.linalg.norm(normal, axis=1)
    depth1 = -(normal * cross(rays[1], translation)).sum(1)
    depth2 = -(normal * cross(turned, translation)).sum(1)
    in_front = ((depth1 > 0) & (depth2 > 0)) | (parallax < _MIN_PARALLAX_PX / max(focal1, focal2))
    return np.where(in_front, errors, np.inf)


def pinhole(focal: float) -> dict[str, object]:
    """PoseLib's camera for pixels relative to the principal point; it does not read width and height."""
    return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal, 0, 0]}
