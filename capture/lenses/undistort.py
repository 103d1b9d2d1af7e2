"""Undistortion: frames of a calibrated lens, resampled to the pinhole with square pixels that recon models."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage
from splatnode.capture.frame import Frame, Intrinsics, RightImage, grey
from splatnode.capture.lenses import opencv
from splatnode.capture.lenses.lens import project
from splatnode.capture.lenses.wide_pinhole import wide_pinhole
from splatnode.capture.masks import Mask, fill_masked

Array = npt.NDArray[np.float64]

SQUARE_TOLERANCE = 0.002  # relative difference of fx and fy below which pixels are square: a pixel in 500
_MIN_SIDE = 0.3  # shorter side of the rectangle that is kept, over the undistorted one's: less is no picture
_EDGE_PX = 0.01  # beyond the picture's border that still counts as seen: what rounding moves
_POINTS_A_SIDE = 33  # of the picture's border that are undistorted, to find the rectangle between them
_MAX_ROUND_TRIP_PX = 0.5  # from a border point to its ray and back: a model that folds over misses by many pixels


def undistort_frame(frame: Frame) -> Frame:
    """The frame without its lens' distortion and with fx = fy; the frame itself where there is nothing to undo.

    It has the same size in pixels and shows the largest rectangle without unseen corners, whose pixels would be
    invented. A fisheye's has as many pixels in another shape, and a mask where the fisheye saw nothing
    (wide_pinhole.py). Its right image, if it has one, is taken the same way, since both have one lens. An aligned depth
    image keeps its pixels, and gets the lens that they were seen through. Raises
    ValueError for coefficients that fold the picture over.
    """
    if frame.right is None:
        return _undistort_single(frame)
    seen = cv2.cvtColor(frame.right.image, cv2.COLOR_GRAY2RGB).astype(np.uint8, copy=False)
    left, right = (
        _undistort_single(replace(frame, right=None)),
        _undistort_single(replace(frame, image=seen, mask=None, right=None)),
    )
    return replace(left, right=RightImage(grey(right.image), frame.right.baseline))


def straighten_depth(frame: Frame) -> DepthImage | None:
    """The frame's depth image as `undistort_frame` leaves it: aligned with resampled pixels, it has their old lens."""
    given, depth = frame.intrinsics, frame.depth
    if depth is None or given is None or not is_resampled(frame):
        return depth
    return depth.apply_lens(given.resized(frame.width, frame.height))


def is_resampled(frame: Frame) -> bool:
    """Whether `undistort_frame` makes another picture of the frame: its lens is no pinhole with square pixels."""
    given = frame.intrinsics
    return given is not None and (given.model == "fisheye" or not _is_square_pinhole(given))


def _is_square_pinhole(given: Intrinsics) -> bool:
    return not any(given.distortion) and abs(given.fx / given.fy - 1.0) < SQUARE_TOLERANCE


def _undistort_single(frame: Frame) -> Frame:
    """As `undistort_frame`, of a frame without a right image."""
    given = frame.intrinsics
    if given is None:
        return frame
    given = given.resized(frame.width, frame.height)
    if frame.depth is not None:
        frame = replace(frame, depth=straighten_depth(frame))
    if given.model == "fisheye":
        return _undistort_fisheye(frame, given)
    if _is_square_pinhole(given):
        return frame if given == frame.intrinsics else replace(frame, intrinsics=given)
    coefficients = opencv.coefficients(given)
    left, top, right, bottom = _find_inner_rectangle(frame.name, given, coefficients)
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
        opencv.camera_matrix(given),
        coefficients,
        np.eye(3),
        opencv.camera_matrix(pinhole),
        (frame.width, frame.height),
        cv2.CV_32FC1,
    )
    image = cv2.remap(frame.image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    mask = None if frame.mask is None else _remap_mask(frame.mask, columns, rows)
    return replace(frame, image=image.astype(np.uint8), intrinsics=pinhole, mask=mask)


def undistort_image(image: npt.NDArray[np.uint8], lens: Intrinsics | None) -> npt.NDArray[np.uint8]:
    """A photograph (H, W, 3), at any size, as `undistort_frame` shows it; itself without a lens. Raises likewise."""
    return image if lens is None else undistort_frame(Frame(0, "photograph", 0, image, lens)).image


def _remap_mask(mask: npt.NDArray[np.bool_], columns: npt.NDArray, rows: npt.NDArray) -> npt.NDArray[np.bool_]:
    """The mask (H, W) as its photograph is resampled; a pixel is used where all that it is made of is."""
    return cv2.remap(mask.astype(np.float32), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) > 0.999


def _undistort_fisheye(frame: Frame, given: Intrinsics) -> Frame:
    """The frame as a pinhole would have seen it; what the fisheye did not see is filled and masked."""
    pinhole = wide_pinhole(frame.name, given)
    across, down = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    slopes = (across - pinhole.cx) / pinhole.fx, (down - pinhole.cy) / pinhole.fy
    rays = np.asarray(np.stack([*slopes, np.ones_like(across)], -1).reshape(-1, 3), np.float64)
    pixels = project(rays, given).reshape(*across.shape, 2)
    size = frame.width, frame.height
    used: Mask = np.all((pixels >= -_EDGE_PX) & (pixels <= np.array(size) + _EDGE_PX), axis=-1)
    columns, rows = np.moveaxis(np.nan_to_num(pixels - 0.5, nan=-1.0), -1, 0).astype(np.float32)
    image = cv2.remap(frame.image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)
    if frame.mask is not None:
        used = used & _remap_mask(frame.mask, columns, rows)
    if used.all():
        return replace(frame, image=image, intrinsics=pinhole, mask=None)
    return replace(frame, image=fill_masked(image, used), intrinsics=pinhole, mask=used)


def _find_inner_rectangle(name: str, given: Intrinsics, coefficients: Array) -> tuple[float, float, float, float]:
    """Left, top, right and bottom, at depth 1, of the largest upright rectangle of rays that the picture has.

    Raises ValueError where the distortion folds the picture over.
    """
    across, down = (np.linspace(0.0, side, _POINTS_A_SIDE) - 0.5 for side in (given.width, given.height))
    ends = [
        np.stack([np.full_like(down, across[0]), down], 1),
        np.stack([across, np.full_like(across, down[0])], 1),
        np.stack([np.full_like(down, across[-1]), down], 1),
        np.stack([across, np.full_like(across, down[-1])], 1),
    ]
    matrix = opencv.camera_matrix(given)
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
    if not error < _MAX_ROUND_TRIP_PX or min(right - left, bottom - top) < _MIN_SIDE * plain:
        raise ValueError(
            f"{name}: distortion {given.distortion} folds the picture over at its border. "
            "Calibrate again, with the pattern in the corners of the picture too."
        )
    return left, top, right, bottom
