"""The equidistant fisheye with four terms k1 k2 k3 k4, as OpenCV's `fisheye` has it.

A ray at the angle t from the camera's axis meets the picture t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) focal lengths
from the principal point. Source: Kannala and Brandt, A Generic Camera Model and Calibration Method, 2006.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics

Array = npt.NDArray[np.float64]

_BISECTIONS = 60  # of the angle: to the last bit of a double


def project(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of the camera's frame, which may come from behind it.

    Not a number beyond the angle up to which the terms grow: no picture shows such a ray.
    """
    across = np.hypot(rays[:, 0], rays[:, 1])
    angles = np.arctan2(across, rays[:, 2])
    directions = rays[:, :2] / np.maximum(across, 1e-300)[:, None]
    pixels = directions * distort_angles(angles, lens)[:, None] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    pixels[angles > largest_angle(lens)] = np.nan
    return pixels


def unproject(pixels: Array, lens: Intrinsics) -> Array:
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
