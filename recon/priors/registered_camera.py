"""What the registration knows of a camera, at the modelled size of its keyframe's image."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors.stereo import MIN_SPARSE_POINTS, SparsePoints, estimate_depth_range
from splatnode.recon.registration.known_poses import axis_depths
from splatnode.recon.registration.register import RegisteredCamera, Registration

Array = npt.NDArray[np.float64]

_AROUND = 4.0  # times nearer and farther than where the cameras' axes meet: searched of a camera without points


def compute_modelled_K(graph: ViewGraph, camera: RegisteredCamera) -> Array:
    """(3, 3) the intrinsics of a registered camera for its image at modelled size."""
    keyframe = graph.keyframes[camera.index]

    (sx, sy), (fx, fy), (cx, cy) = keyframe.scale, camera.focals, camera.principal
    return np.array([[fx * sx, 0.0, cx * sx], [0.0, fy * sy, cy * sy], [0.0, 0.0, 1.0]])


def select_sparse_points(
    registration: Registration, camera: RegisteredCamera, scale: tuple[float, float]
) -> SparsePoints:
    """The registered points that a camera observes: their pixels at modelled size, and their depths.

    `scale` is modelled over full width and height, as `Keyframe.scale`.
    """
    mine = registration.observed_by == camera.index
    world = registration.points[registration.observed_point[mine]]
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    depths = world @ T_camera_world[2, :3] + T_camera_world[2, 3]
    return SparsePoints(registration.observed_pixels[mine] * scale, depths)


def compute_depth_range(
    registration: Registration, camera: RegisteredCamera, points: SparsePoints
) -> tuple[float, float]:
    """(near, far) in which a camera's depth is searched: from its `points`; of too few, where others look, too.

    A camera that a given pose holds may have no points: those of the others count, and where the axes of cameras meet.
    """
    if int((points.depths > 0).sum()) >= MIN_SPARSE_POINTS or registration.given is None:
        return estimate_depth_range(points.depths)
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    depths = registration.points @ T_camera_world[2, :3] + T_camera_world[2, 3]
    if int((depths > 0).sum()) >= MIN_SPARSE_POINTS:
        return estimate_depth_range(depths)
    Ts = np.stack([each.T_world_camera for each in registration.cameras])
    depths = axis_depths(np.swapaxes(Ts[:, :3, :3], 1, 2), Ts[:, :3, 3])
    middle = float(np.median(depths)) if len(depths) else 1.0  # the unit of length is the distance to the scene
    return middle / _AROUND, middle * _AROUND
