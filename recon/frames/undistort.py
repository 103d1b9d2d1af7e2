"""Frames of a calibrated lens as a pinhole with square pixels would have taken them: what the rest of recon models."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics

Array = npt.NDArray[np.float64]

SQUARE = 0.002  # relative difference of fx and fy below which pixels are square
_NUM_COEFFICIENTS = (4, 5, 8, 12, 14)  # that OpenCV's lens model takes
_SHORTEST_SIDE = 0.3  # of the rectangle that is kept, over the focal length's: less is no picture


def undistorted(frame: Frame) -> Frame:
    """The frame without its lens' distortion and with fx = fy; the frame itself where there is nothing to take out.

    The largest picture of the same size without unseen corners: pixels outside the distorted one would be invented.
    Raises ValueError for coefficients that OpenCV's model does not have, or that fold the picture over.
    """
    given = frame.intrinsics
    if given is None:
        return frame
    given = given.resized(frame.width, frame.height)
    straight = not any(given.distortion)
    if straight and abs(given.fx / given.fy - 1.0) < SQUARE:
        return frame if given == frame.intrinsics else replace(frame, intrinsics=given)
    coefficients = _coefficients(frame.name, given)
    left, top, right, bottom = _seen_rectangle(frame.name, given, coefficients)
    focal = max(frame.width / (right - left), frame.height / (bottom - top))
    pinhole = replace(
        given,
        fx=focal,
        fy=focal,
        cx=frame.width / 2 - focal * (left + right) / 2,
        cy=frame.height / 2 - focal * (top + bottom) / 2,
        distortion=(),
    )
    columns, rows = cv2.initUndistortRectifyMap(
        _opencv_matrix(given),
        coefficients,
        np.eye(3),
        _opencv_matrix(pinhole),
        (frame.width, frame.height),
        cv2.CV_32FC1,
    )
    image = cv2.remap(frame.image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(frame, image=image.astype(np.uint8), intrinsics=pinhole)


def _coefficients(name: str, given: Intrinsics) -> Array:
    values = given.distortion or (0.0,)
    if len(values) > max(_NUM_COEFFICIENTS):
        raise ValueError(
            f"{name}: distortion must be OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]], "
            f"got {len(values)} numbers. Calibrate with cv2.calibrateCamera."
        )
    wanted = next(count for count in _NUM_COEFFICIENTS if count >= len(values))
    return np.array([*values, *[0.0] * (wanted - len(values))])


def _opencv_matrix(intrinsics: Intrinsics) -> Array:
    """K with the centre of the top-left pixel at (0, 0)."""
    return intrinsics.K - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])


def _seen_rectangle(name: str, given: Intrinsics, coefficients: Array) -> tuple[float, float, float, float]:
    """Left, top, right and bottom, at depth 1, of the largest upright rectangle whose every ray the picture has."""
    across, down = np.linspace(0.0, given.width, 33) - 0.5, np.linspace(0.0, given.height, 33) - 0.5
    ends = [
        np.stack([np.full_like(down, across[0]), down], 1),
        np.stack([across, np.full_like(across, down[0])], 1),
        np.stack([np.full_like(down, across[-1]), down], 1),
        np.stack([across, np.full_like(across, down[-1])], 1),
    ]
    matrix = _opencv_matrix(given)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    straight = [
        cv2.undistortPoints(side[:, None], matrix, coefficients, None, np.eye(3), np.eye(3), criteria)[:, 0]
        for side in ends
    ]
    again = [
        cv2.projectPoints(np.column_stack([rays, np.ones(len(rays))]), np.zeros(3), np.zeros(3), matrix, coefficients)
        for rays in straight
    ]
    error = max(float(np.abs(points[:, 0] - side).max()) for (points, _), side in zip(again, ends, strict=True))
    left, top = float(straight[0][:, 0].max()), float(straight[1][:, 1].max())
    right, bottom = float(straight[2][:, 0].min()), float(straight[3][:, 1].min())
    plain = min(given.width / given.fx, given.height / given.fy)
    if not error < 0.5 or min(right - left, bottom - top) < _SHORTEST_SIDE * plain:
        raise ValueError(
            f"{name}: distortion {given.distortion} folds the picture over at its border. "
            "Calibrate again, with the pattern in the corners of the picture too."
        )
    return left, top, right, bottom
