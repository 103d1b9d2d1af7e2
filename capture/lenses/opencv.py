"""OpenCV's radial-tangential lens: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]; without any, a pinhole."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics

Array = npt.NDArray[np.float64]

_COUNTS = (4, 5, 8, 12, 14)  # of coefficients that OpenCV takes
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)


def project(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of the camera's frame; not a number behind the camera."""
    ahead = rays[:, 2] > 0
    pixels = np.full((len(rays), 2), np.nan)
    if ahead.any():
        seen, _ = cv2.projectPoints(
            rays[ahead] / rays[ahead, 2:], np.zeros(3), np.zeros(3), camera_matrix(lens), coefficients(lens)
        )
        pixels[ahead] = seen[:, 0] + 0.5
    return pixels


def unproject(pixels: Array, lens: Intrinsics) -> Array:
    """(M, 3) unit rays of the camera's frame that meet pixels (M, 2), found by iteration."""
    points = np.ascontiguousarray(pixels[:, None] - 0.5)
    at_depth_1 = cv2.undistortPoints(
        points, camera_matrix(lens), coefficients(lens), None, np.eye(3), np.eye(3), _CRITERIA
    )[:, 0]
    rays = np.column_stack([at_depth_1, np.ones(len(at_depth_1))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def coefficients(lens: Intrinsics) -> Array:
    """The lens' coefficients, filled up with zeros to a number that OpenCV takes."""
    values = lens.distortion or (0.0,)
    wanted = next(count for count in _COUNTS if count >= len(values))
    return np.array([*values, *[0.0] * (wanted - len(values))])


def camera_matrix(lens: Intrinsics) -> Array:
    """K (3, 3) as OpenCV has it, with the centre of the top-left pixel at (0, 0)."""
    return lens.K - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
