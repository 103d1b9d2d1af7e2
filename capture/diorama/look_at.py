"""A camera that looks at a point."""

from __future__ import annotations

import numpy as np

from splatnode.capture.diorama.cast import Matrix


def look_at(centre: Matrix, target: Matrix, roll_deg: float = 0.0) -> Matrix:
    """T_world_camera (4, 4) at `centre`, its z axis towards `target`, upright in a world whose z is up, then rolled."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cosine, sine = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack([cosine * right + sine * down, cosine * down - sine * right, forward], 1)
    T_world_camera[:3, 3] = centre
    return T_world_camera
