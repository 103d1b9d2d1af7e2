"""Normals of a depth map that has none of its own."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Map = npt.NDArray[np.float32]


def compute_depth_normals(depth: Map, K: npt.NDArray[np.float64], max_step: float = 0.1) -> Map:
    """(H, W, 3) unit normals in the camera frame, facing the camera; 0 where they are not known.

    From the points of the neighbours on both sides (one side at borders and at steps of the depth by more than
    `max_step`, relatively). `depth` (H, W) is z, 0 where unknown; K is (3, 3).
    """
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    z = depth.astype(np.float64)
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], -1)
    along_u, along_v = _slope(points, 1, max_step), _slope(points, 0, max_step)
    normal = np.cross(along_u, along_v)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    known = (length > 0) & (depth[..., None] > 0)
    normal = np.where(known, normal / np.where(length > 0, length, 1.0), 0.0)
    away = (normal * points).sum(-1, keepdims=True) > 0
    return np.where(away, -normal, normal).astype(np.float32)


def _slope(points: npt.NDArray[np.float64], axis: int, max_step: float) -> npt.NDArray[np.float64]:
    """Change of the points (H, W, 3) along `axis`: the sum of the steps to both neighbours that lie on the surface."""
    step = np.diff(points, axis=axis)
    first, second = (points.take(range(a, points.shape[axis] + b), axis=axis)[..., 2:] for a, b in ((0, -1), (1, 0)))
    joined = (first > 0) & (second > 0) & (np.abs(first - second) <= max_step * np.minimum(first, second))
    step = np.where(joined, step, 0.0)
    pad = [(0, 0)] * 3
    pad[axis] = (1, 0)
    before = np.pad(step, pad)
    pad[axis] = (0, 1)
    return before + np.pad(step, pad)
