"""What is truly solid in a made place, and what of it two cameras see."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama import Camera, Shape, Solid, trace

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SAME = 0.01  # relative difference of depth up to which two cameras see the same point
_SAMPLES = 4  # along each side of a voxel


def inside(solids: Sequence[Solid], points: Array) -> Mask:
    """(M,) which of the points (M, 3) are in a solid."""
    found = np.zeros(len(points), bool)
    for solid, near in _neighbours(solids, points, 0.0):
        found[near[_within(solid.shape, solid.transform_to_local(points[near]))]] = True
    return found


def touched(solids: Sequence[Solid], centres: Array, axes: Array) -> Mask:
    """(M,) which parallelepipeds around `centres` (M, 3) a solid reaches into; `axes` (3, 3) are their sides.

    Each is sampled at 4 x 4 x 4 points.
    """
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    offsets = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3) @ axes.T
    found = np.zeros(len(centres), bool)
    for solid, near in _neighbours(solids, centres, float(np.abs(offsets).max())):
        for offset in offsets:
            found[near[_within(solid.shape, solid.transform_to_local(centres[near] + offset))]] = True
    return found


def _neighbours(solids: Sequence[Solid], points: Array, margin: float) -> Iterator[tuple[Solid, npt.NDArray[np.intp]]]:
    """Each solid that has points (M, 3) within `margin` of the box around it, and which these are."""
    order = np.argsort(points[:, 0])
    x = points[order, 0]
    for solid in solids:
        low, high = solid.corners.min(0) - margin, solid.corners.max(0) + margin
        slab = order[np.searchsorted(x, low[0]) : np.searchsorted(x, high[0], "right")]
        near = slab[((points[slab, 1:] >= low[1:]) & (points[slab, 1:] <= high[1:])).all(1)]
        if len(near):
            yield solid, near


def _within(shape: Shape, local: Array) -> Mask:
    if shape is Shape.BOX:
        return np.abs(local).max(1) <= 1
    if shape is Shape.ELLIPSOID:
        return np.linalg.norm(local, axis=1) <= 1
    return (np.hypot(local[:, 0], local[:, 1]) <= 1) & (np.abs(local[:, 2]) <= 1)


def surface(solids: Sequence[Solid], camera: Camera, width: int, height: int) -> tuple[Array, npt.NDArray[np.float32]]:
    """(M, 3) what a camera's pixels show, and (H, W) its z; inf for nothing."""
    T, K = camera
    z, _ = trace(solids, camera, width, height)
    rows, columns = np.nonzero(np.isfinite(z))
    depth = z[rows, columns].astype(np.float64)
    rays = np.stack([(columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(rows))], 1)
    return (rays * depth[:, None]) @ T[:3, :3].T + T[:3, 3], z


def reached(points: Array, camera: Camera, z: npt.NDArray[np.float32]) -> tuple[Mask, Mask]:
    """(M,) which points (M, 3) lie before or on what the camera sees, and (M,) which of them on it."""
    T, K = camera
    local = (points - T[:3, 3]) @ T[:3, :3]
    ahead = np.maximum(local[:, 2], 1e-9)
    columns, rows = (local[:, axis] / ahead * K[axis, axis] + K[axis, 2] for axis in (0, 1))
    height, width = z.shape
    seen = (local[:, 2] > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    end = z[np.clip(rows, 0, height - 1).astype(int), np.clip(columns, 0, width - 1).astype(int)]
    return seen & (ahead <= (1 + SAME) * end), seen & (np.abs(ahead - end) <= SAME * end)
