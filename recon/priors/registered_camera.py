"""What the registration knows of a camera, at the modelled size of its keyframe's image."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors.stereo import SparsePoints
from splatnode.recon.registration.register import RegisteredCamera, Registration

Array = npt.NDArray[np.float64]


def modelled_K(graph: ViewGraph, camera: RegisteredCamera) -> Array:
    """(3, 3) the intrinsics of a registered camera for its image at modelled size."""
    keyframe = graph.keyframes[camera.index]

    (sx, sy), (fx, fy), (cx, cy) = keyframe.scale, camera.focals, camera.principal
    return np.array([[fx * sx, 0.0, cx * sx], [0.0, fy * sy, cy * sy], [0.0, 0.0, 1.0]])


def sparse_points(registration: Registration, camera: RegisteredCamera, scale: tuple[float, float]) -> SparsePoints:
    """The registered points that a camera observes: their pixels at modelled size, and their depths.

    `scale` is modelled over full width and height, as `Keyframe.scale`.
    """
    mine = registration.observed_by == camera.index
    world = registration.points[registration.observed_point[mine]]
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    depths = world @ T_camera_world[2, :3] + T_camera_world[2, 3]
    return SparsePoints(registration.observed_pixels[mine] * scale, depths)
