"""Gaussians painted as points: squares of one size at their centres, the nearest on top."""

from __future__ import annotations

import cv2
import numpy as np

from splatnode.recon.result.export.prepare import compute_base_rgb
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.viewer.canvas import BACKGROUND, NEAR, Array, Canvas, transform_to_camera


def paint_points(
    gaussians: GaussianArrays, T_camera_world: Array, K: Array, size: int, width: int, height: int
) -> Canvas:
    """A canvas with squares of `size` pixels at the centres of the Gaussians."""
    points = transform_to_camera(gaussians.means, T_camera_world.astype(np.float32))
    ahead = np.flatnonzero(points[:, 2] > NEAR)
    z = points[ahead, 2]
    focal, corner = K[[0, 1], [0, 1]].astype(np.float32), (K[:2, 2] - size / 2 + 0.5).astype(np.float32)
    columns, rows = np.floor(points[ahead, :2] / z[:, None] * focal + corner).T
    seen = np.flatnonzero((columns > -size) & (columns < width) & (rows > -size) & (rows < height))
    order = seen[np.argsort(-z[seen])]
    columns, rows = columns[order].astype(np.intp), rows[order].astype(np.intp)
    # A frame around the picture takes what sticks out of it. The nearest owns a pixel: it has the largest number, and
    # the last assignment stays. Dilation makes squares of them (float32 holds whole numbers up to 2^24).
    wide = np.zeros((height + 2 * size, width + 2 * size), np.float32)
    wide[rows + size, columns + size] = np.arange(1, len(order) + 1, dtype=np.float32)
    squares = cv2.dilate(wide, np.ones((size, size), np.uint8), anchor=(size - 1, size - 1))
    owner = squares[size : size + height, size : size + width].astype(np.intp)  # 0, where nobody owns a pixel
    colours = np.zeros((len(order) + 1, 4), np.uint8)  # four bytes are one number, which is gathered at once
    colours[0, :3], colours[1:, :3] = BACKGROUND, compute_base_rgb(gaussians)[ahead[order]]
    depths = np.concatenate([np.array([np.inf], np.float32), z[order]])
    # Every owner is a valid index; "clip" spares take the buffer that its check would need.
    four = colours.view(np.uint32)[:, 0].take(owner, mode="clip")[..., None].view(np.uint8)
    return Canvas(np.asarray(cv2.cvtColor(four, cv2.COLOR_RGBA2RGB), np.uint8), depths.take(owner, mode="clip"))
