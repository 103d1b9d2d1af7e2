"""Lens models: from rays of the camera's frame to pixels of the picture and back, and frames without distortion.

OpenCV's radial-tangential lens has k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]; without any it is a pinhole. The
equidistant fisheye has four terms k1 k2 k3 k4, as OpenCV's `fisheye` has it: a ray at the angle t from the camera's
axis meets the picture t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) focal lengths from the principal point (Kannala and
Brandt, A Generic Camera Model and Calibration Method, 2006). Frames of a calibrated lens are resampled to the pinhole
with square pixels that recon models; the one of a fisheye holds what it sees, as far as a pinhole can.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage
from splatnode.capture.frame import Frame, Intrinsics, RightImage, grey
from splatnode.capture.masks import Mask, fill_masked

Array = npt.NDArray[np.float64]

_COUNTS = (4, 5, 8, 12, 14)  # of coefficients that OpenCV takes
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)


def project_opencv(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of the camera's frame; not a number behind the camera."""
    ahead = rays[:, 2] > 0
    pixels = np.full((len(rays), 2), np.nan)
    if ahead.any():
        seen, _ = cv2.projectPoints(
            rays[ahead] / rays[ahead, 2:], np.zeros(3), np.zeros(3), camera_matrix(lens), coefficients(lens)
        )
        pixels[ahead] = seen[:, 0] + 0.5
    return pixels


def unproject_opencv(pixels: Array, lens: Intrinsics) -> Array:
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


_BISECTIONS = 60  # of the angle: to the last bit of a double


def project_fisheye(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of the camera's frame, which may come from behind it.

    Not a number beyond the angle up to which the terms grow: no picture shows such a ray.
    """
    across = np.hypot(rays[:, 0], rays[:, 1])
    angles = np.arctan2(across, rays[:, 2])
    directions = rays[:, :2] / np.maximum(across, 1e-300)[:, None]
    pixels = directions * distort_angles(angles, lens)[:, None] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    pixels[angles > largest_angle(lens)] = np.nan
    return pixels


def unproject_fisheye(pixels: Array, lens: Intrinsics) -> Array:
    """(M, 3) unit rays of the camera's frame that meet pixels (M, 2); not a number where no ray does."""
    points = (pixels - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    radii = np.linalg.norm(points, axis=1)
    low, high = np.zeros(len(radii)), np.full(len(radii), largest_angle(lens))
    reached = radii <= distort_angles(high, lens)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        further = distort_angles(middle, lens) < radii
        low, high = np.where(further, middle, low), np.where(further, high, middle)
    angles = (low + high) / 2
    directions = points / np.maximum(radii, 1e-300)[:, None]
    rays = np.column_stack([directions * np.sin(angles)[:, None], np.cos(angles)])
    rays[~reached] = np.nan
    return rays


def distort_angles(angles: Array, lens: Intrinsics) -> Array:
    """How far from the principal point, in focal lengths, rays at `angles` (M,) from the axis, radians, are seen."""
    squared = angles**2
    growth = np.ones_like(angles)
    for power, term in enumerate(lens.distortion, start=1):
        growth = growth + term * squared**power
    return angles * growth


def largest_angle(lens: Intrinsics) -> float:
    """The angle from the axis, radians, up to which rays farther out are seen farther out; pi where all are."""
    derivative = [1.0, *((2 * power + 1) * term for power, term in enumerate(lens.distortion, start=1))]
    roots = np.roots(derivative[::-1])  # of the squared angle
    turns = [root.real for root in roots if abs(root.imag) < 1e-9 * abs(root) + 1e-12 and root.real > 0]
    return float(min(np.pi, *(np.sqrt(turn) for turn in turns))) if turns else float(np.pi)


_PROJECT = {"opencv": project_opencv, "fisheye": project_fisheye}
_UNPROJECT = {"opencv": unproject_opencv, "fisheye": unproject_fisheye}


def project(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of any length, camera frame; the top-left pixel's centre is at (0.5, 0.5).

    Not a number where the lens does not see the ray.
    """
    if rays.ndim != 2 or rays.shape[1] != 3:
        raise ValueError(f"rays must be (M, 3), got {rays.shape}")
    return _PROJECT[lens.model](np.asarray(rays, np.float64), lens)


def unproject(pixels: Array, lens: Intrinsics) -> Array:
    """(M, 3) unit rays, camera frame, of pixels (M, 2); not a number where no ray meets the pixel."""
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(f"pixels must be (M, 2), got {pixels.shape}")
    return _UNPROJECT[lens.model](np.asarray(pixels, np.float64), lens)


# From the axis to each side. A pinhole spends 1 / cos^2 as many pixels on a degree there as in its middle: four times
# as many at 60 degrees, 33 times at 80.
MOST_DEG = 60.0
_LARGEST = math.tan(math.radians(MOST_DEG))  # the same at depth 1
_FURTHEST = math.atan(math.hypot(_LARGEST, _LARGEST))  # radians, of a corner that is kept


def wide_pinhole(name: str, given: Intrinsics) -> Intrinsics:
    """A pinhole with square pixels of as many pixels in all, which a fisheye's picture is resampled to.

    Left, right, up and down it sees as far as the fisheye does there, at most MOST_DEG from the axis. Raises
    ValueError for terms that turn back within the picture, and for a picture that is not around the axis.
    """
    corners = [(x - given.cx, y - given.cy) for x in (0, given.width) for y in (0, given.height)]
    furthest = max(math.hypot(x / given.fx, y / given.fy) for x, y in corners)
    turn = largest_angle(given)
    if turn < _FURTHEST and float(distort_angles(np.array(turn), given)) < furthest:
        raise ValueError(
            f"{name}: the fisheye terms {given.distortion} turn back {math.degrees(turn):.0f} degrees from the axis, "
            "within the picture, which no lens does. Calibrate again, with the pattern in the corners of the picture "
            "too, or give model: opencv if the terms are k1 k2 p1 p2."
        )
    if not (0 < given.cx < given.width and 0 < given.cy < given.height):
        raise ValueError(
            f"{name}: the principal point ({given.cx:g}, {given.cy:g}) of a fisheye must be within its picture of "
            f"{given.width} x {given.height} pixels. Give the calibration of the whole picture."
        )
    sides = [[0.0, given.cy], [given.width, given.cy], [given.cx, 0.0], [given.cx, given.height]]
    left, right, top, bottom = (_slope(ray) for ray in unproject(np.array(sides), given))
    focal = math.sqrt(given.width * given.height / ((left + right) * (top + bottom)))
    width, height = round(focal * (left + right)), round(focal * (top + bottom))
    return replace(
        given, width=width, height=height, fx=focal, fy=focal, cx=focal * left, cy=focal * top, distortion=(),
        model="opencv",
    )  # fmt: skip


def _slope(ray: np.ndarray) -> float:
    """How far from the axis a ray (3,) is at depth 1, at most as far as is kept; the most where no ray is."""
    across = math.hypot(ray[0], ray[1])
    return float(across / ray[2]) if ray[2] > 0 and across < _LARGEST * ray[2] else _LARGEST


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
    terms = coefficients(given)
    left, top, right, bottom = _find_inner_rectangle(frame.name, given, terms)
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
        camera_matrix(given),
        terms,
        np.eye(3),
        camera_matrix(pinhole),
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
    matrix = camera_matrix(given)
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
