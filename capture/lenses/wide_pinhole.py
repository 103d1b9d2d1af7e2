"""The pinhole that holds what a fisheye sees, as far as a pinhole can."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import fisheye
from splatnode.capture.lenses.lens import unproject

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
    turn = fisheye.largest_angle(given)
    if turn < _FURTHEST and float(fisheye.distort_angles(np.array(turn), given)) < furthest:
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
