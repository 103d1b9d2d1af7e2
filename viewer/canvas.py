"""The picture that is being painted: colours, and how far what they show is away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.viewer.viewpoint import Viewpoint

Array = npt.NDArray[np.floating]
Image = npt.NDArray[np.uint8]  # (H, W, 3) RGB

BACKGROUND = (24, 26, 30)
NEAR = 0.005  # world units: nothing closer is drawn


@dataclass(frozen=True, eq=False)
class Canvas:
    image: Image
    depth: npt.NDArray[np.float32]  # (H, W) z of what is there, infinite where there is nothing


def empty_canvas(width: int, height: int) -> Canvas:
    return Canvas(np.full((height, width, 3), BACKGROUND, np.uint8), np.full((height, width), np.inf, np.float32))


def project(points: Array, view: Viewpoint, width: int, height: int) -> Array:
    """(M, 3) pixel x, pixel y and z of world points (M, 3) in the window."""
    local = transform_to_camera(points, np.linalg.inv(view.T_world_camera))
    z = np.where(np.abs(local[:, 2]) > 1e-9, local[:, 2], 1e-9)
    homogeneous = local @ view.K(width, height).T
    return np.column_stack([homogeneous[:, :2] / z[:, None], local[:, 2]])


def transform_to_camera(points: Array, T_camera_world: Array) -> Array:
    """(..., 3) world points in the camera's frame."""
    return points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
