"""Carving: which voxels rays of confirmed depth pass, whole, and well before they end."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.layout import Layout
from splatnode.recon.occupancy.sight import DepthObservation

Float32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

KNOWN_SHARE = 0.8  # of the pixels that a voxel covers: so many must have a confirmed depth, all of them beyond it
STOP_SHORT = 1.0  # voxels by which a ray ends before the surface, beside its uncertainty
_RADII = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # pixels, of the squares that voxels are looked up in
_AT_ONCE = 2_000_000  # voxels


def ignore_cancel() -> None:
    """Ignores the check for cancellation, for work that nobody interrupts."""


def carve_free_space(
    sight: DepthObservation,
    layout: Layout,
    T_world_map: npt.NDArray[np.float64],
    pause: Callable[[], None] = ignore_cancel,
) -> Mask:
    """(X, Y, Z) the voxels that the camera looks through; `pause` is called in between, and may raise.

    A voxel is covered by the pixels around its centre that its bounding sphere reaches. Each of them must end beyond
    the sphere, by the depth's uncertainty and a voxel; KNOWN_SHARE of them must have a depth.
    """
    limits = _limits(sight, STOP_SHORT * layout.voxel)
    reach = np.float32(np.sqrt(3.0) / 2.0 * layout.voxel)
    T_camera_map = np.linalg.inv(sight.T_world_camera) @ T_world_map
    start = T_camera_map[:3, :3] @ (layout.origin + layout.voxel / 2) + T_camera_map[:3, 3]
    steps = layout.voxel * T_camera_map[:3, :3]
    free = np.zeros(layout.shape, bool)
    rows = max(1, _AT_ONCE // (layout.shape[1] * layout.shape[2]))
    for first in range(0, layout.shape[0], rows):
        pause()
        part = slice(first, min(first + rows, layout.shape[0]))
        free[part] = _carve_block(_coordinates(start, steps, part, layout.shape), sight.K, limits, reach)
    return free


def _coordinates(
    start: npt.NDArray[np.float64], steps: npt.NDArray[np.float64], part: slice, shape: tuple[int, int, int]
) -> tuple[Float32, Float32, Float32]:
    """x, y and z (X', Y, Z) of the voxels' centres in the camera's frame."""
    i, j, k = (np.arange(a, b) for a, b in ((part.start, part.stop), (0, shape[1]), (0, shape[2])))
    along_i, along_j, along_k = (
        (steps[:, axis, None] * number).astype(np.float32) for axis, number in enumerate((i, j, k))
    )
    x, y, z = (
        np.float32(start[row]) + along_i[row][:, None, None] + along_j[row][None, :, None] + along_k[row][None, None, :]
        for row in range(3)
    )
    return x, y, z


def _carve_block(
    centres: tuple[Float32, Float32, Float32], K: npt.NDArray[np.float64], limits: Float32, reach: np.float32
) -> Mask:
    x, y, z = centres
    ahead = np.flatnonzero(z > 2 * reach)
    x, y, z = x.ravel()[ahead], y.ravel()[ahead], z.ravel()[ahead]
    column, row = np.float32(K[0, 0]) * x / z + np.float32(K[0, 2]), np.float32(K[1, 1]) * y / z + np.float32(K[1, 2])
    radius = np.float32(max(K[0, 0], K[1, 1])) * reach / (z - reach) + np.float32(0.5)
    height, width = limits.shape[1:]
    seen = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (radius <= _RADII[-1])
    level = np.searchsorted(np.array(_RADII, np.float32), radius[seen])
    limit = limits[level, row[seen].astype(np.intp), column[seen].astype(np.intp)]
    free = np.zeros(centres[0].size, bool)
    free[ahead[seen]] = limit > z[seen] + reach
    return free.reshape(centres[0].shape)


def _limits(sight: DepthObservation, stop_short: float) -> Float32:
    """(radii, h, w) how far all rays of the square around a pixel pass; 0 where too few of them are known."""
    known = sight.depth > 0
    far = np.float32(np.finfo(np.float32).max)
    ends = np.where(known, (1.0 - sight.error) * sight.depth - stop_short, far).astype(np.float32)
    limits = []
    for radius in _RADII:
        window = np.ones((2 * radius + 1,) * 2, np.uint8)
        nearest = cv2.erode(ends, window, borderType=cv2.BORDER_CONSTANT, borderValue=(float(far),))
        share = cv2.blur(known.astype(np.float32), window.shape, borderType=cv2.BORDER_CONSTANT)
        limits.append(np.where((share >= KNOWN_SHARE - 1e-4) & (nearest < far), nearest, 0.0))
    return np.stack(limits).astype(np.float32)
