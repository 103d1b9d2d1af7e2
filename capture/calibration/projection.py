"""Pixels of points, and how they change with the point and with the numbers of the lens.

The models are those of `capture.lenses`, which a test compares them with. Their derivatives are worked out by hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_NEAREST = 1e-6  # to the camera's axis, as a share of the depth: nearer, 0 / 0
_AHEAD = 1e-3  # of the distance: what a radial lens sees is at least so far before it


@dataclass(frozen=True, eq=False)
class Projection:
    """M points through a lens of P numbers; not a number where the lens cannot see a point."""

    pixels: Array  # (M, 2)
    by_point: Array  # (M, 2, 3)
    by_lens: Array  # (M, 2, P): fx fy cx cy and the terms


def project_points(points: Array, numbers: Array, kind: str) -> Projection:
    """Points (M, 3) of the camera's frame through the lens fx fy cx cy and terms, which is "opencv" or "fisheye"."""
    bent = _fisheye if kind == "fisheye" else _opencv
    flat, by_point, by_terms = bent(points, numbers[4:])
    focal = numbers[:2]
    by_lens = np.zeros((len(points), 2, len(numbers)))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = flat[:, 0], flat[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    by_lens[:, :, 4:] = by_terms * focal[:, None]
    return Projection(flat * focal + numbers[2:4], by_point * focal[:, None], by_lens)


def _fisheye(points: Array, terms: Array) -> tuple[Array, Array, Array]:
    """Projects points in focal lengths (M, 2), with derivatives by point (M, 2, 3) and by term (M, 2, T)."""
    x, y, z = points.T
    across = np.maximum(np.hypot(x, y), _NEAREST * np.abs(z) + 1e-12)
    angle = np.arctan2(across, z)
    powers = angle[:, None] ** np.arange(3, 2 * len(terms) + 2, 2)  # of k1, k2, ...
    radius = angle + powers @ terms
    growth = 1 + (powers * np.arange(3, 2 * len(terms) + 2, 2) / angle[:, None]) @ terms  # of the radius, by the angle
    squared = across**2 + z**2
    scale = radius / across
    aside = (growth * z / squared - scale) / across**2  # of the scale, by x or y, divided by that
    along = -growth / squared  # of the scale, by z
    side = points[:, :2]
    by_point = np.empty((len(points), 2, 3))
    by_point[:, :, :2] = side[:, :, None] * side[:, None, :] * aside[:, None, None]
    by_point[:, 0, 0] += scale
    by_point[:, 1, 1] += scale
    by_point[:, :, 2] = side * along[:, None]
    return side * scale[:, None], by_point, side[:, :, None] * (powers / across[:, None])[:, None, :]


def _opencv(points: Array, terms: Array) -> tuple[Array, Array, Array]:
    """As `_fisheye`, of k1 k2 p1 p2 k3 k4 k5 k6, or as many of them as there are."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([terms, np.zeros(8 - len(terms))])
    depth = np.where(points[:, 2] > _AHEAD * np.linalg.norm(points, axis=1), points[:, 2], np.nan)
    x, y = points[:, 0] / depth, points[:, 1] / depth
    r2 = x * x + y * y
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    below = np.where(below > 0, below, np.nan)  # beyond the pole there is no picture
    radial = above / below
    growth = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below  # by r2
    flat = np.column_stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    )
    mixed = 2 * x * y * growth + 2 * p1 * x + 2 * p2 * y
    by_x = np.column_stack([radial + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x, mixed])
    by_y = np.column_stack([mixed, radial + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x])
    by_point = np.stack([by_x, by_y, -(by_x * x[:, None] + by_y * y[:, None])], axis=-1) / depth[:, None, None]
    side = np.column_stack([x, y])
    above_terms = side[:, :, None] * (r2[:, None] ** [1, 2, 3] / below[:, None])[:, None, :]
    below_terms = -above_terms * radial[:, None, None]
    tangential = np.stack(
        [np.column_stack([2 * x * y, r2 + 2 * y * y]), np.column_stack([r2 + 2 * x * x, 2 * x * y])], axis=-1
    )
    by_terms = np.concatenate([above_terms[:, :, :2], tangential, above_terms[:, :, 2:], below_terms], axis=-1)
    return flat, by_point, by_terms[:, :, : len(terms)]
