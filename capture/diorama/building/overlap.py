"""How much of the same surface two cameras see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.building.view import BuildingState, depth
from splatnode.capture.diorama.cast import Camera, Matrix

COLUMNS = 40  # of the grid of rays on which it is measured
TOLERANCE = 0.04  # of the depth, by which the same surface may differ
GRAZING = 0.06  # metres added to it, for surfaces seen at a slant


@dataclass(frozen=True, eq=False)
class CoarseView:
    """A coarse view of a camera: `z` (h, w) at pixel centres of the small image with `K`."""

    T_world_camera: Matrix
    K: Matrix
    z: npt.NDArray[np.float32]


def render_coarse_view(state: BuildingState, camera: Camera, width: int, height: int) -> CoarseView:
    """Renders the coarse view of a camera with images of `width` x `height` pixels."""
    T_world_camera, K = camera
    small = COLUMNS, max(1, round(COLUMNS * height / width))
    scaled = np.diag([small[0] / width, small[1] / height, 1.0]) @ K
    return CoarseView(T_world_camera, scaled, depth(state, (T_world_camera, scaled), *small))


def compute_overlap(first: CoarseView, second: CoarseView) -> float:
    """0 to 1: the share of what one sees that the other sees, too; of both ways the lesser."""
    return min(_share(first, second), _share(second, first))


def _share(first: CoarseView, second: CoarseView) -> float:
    rows, columns = first.z.shape
    u, v = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    known = np.isfinite(first.z)
    rays = np.stack([u, v, np.ones_like(u)], -1)[known] @ np.linalg.inv(first.K).T
    T_second_first = np.linalg.inv(second.T_world_camera) @ first.T_world_camera
    points = (rays * first.z[known][:, None]) @ T_second_first[:3, :3].T + T_second_first[:3, 3]
    ahead = points[:, 2] > 0.05
    pixels = points[ahead] @ second.K.T
    x, y = (np.floor(pixels[:, axis] / pixels[:, 2]).astype(int) for axis in (0, 1))
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    z, found = points[ahead][inside, 2], second.z[y[inside], x[inside]]
    same = np.abs(z - found) < GRAZING + TOLERANCE * z
    return float(same.sum()) / first.z.size
