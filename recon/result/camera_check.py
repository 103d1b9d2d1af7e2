"""What a camera must be that a stranger wrote: a rigid motion and a pinhole, in numbers that can be computed with."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MAX_COORDINATE = 1e9  # of a camera's centre, in its file's unit, and of what K holds, in pixels
MAX_SIDE = 65_535  # pixels of an image
SHORTEST_FOCAL = 1e-3  # pixels
_RIGID = 1e-2  # largest difference of a rotation times its transpose from the identity
_EXACT = 1e-6  # by which what is 0 or 1 in every such matrix may differ from it


def find_camera_problem(T_world_camera: Array, K: Array, width: int, height: int) -> str:
    """Describes what is wrong with the camera; empty where nothing is."""
    if T_world_camera.shape != (4, 4) or K.shape != (3, 3):
        return f"T_world_camera must be 4x4 and K 3x3, got {T_world_camera.shape} and {K.shape}"
    if not (np.abs(T_world_camera) <= MAX_COORDINATE).all() or not (np.abs(K) <= MAX_COORDINATE).all():
        return f"T_world_camera and K must be finite, within ±{MAX_COORDINATE:g}"
    rotation = T_world_camera[:3, :3]
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0
    if turned or not np.allclose(T_world_camera[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=_EXACT):
        return "T_world_camera must be a rigid motion"
    if min(K[0, 0], K[1, 1]) < SHORTEST_FOCAL or not np.allclose(K[2], [0.0, 0.0, 1.0], rtol=0.0, atol=_EXACT):
        return f"K must have focal lengths of {SHORTEST_FOCAL:g} pixels or more, and 0 0 1 as its last row"
    if not np.allclose([K[0, 1], K[1, 0]], 0.0, rtol=0.0, atol=_EXACT):
        return "K must have no skew"
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        return f"width and height must be 1 to {MAX_SIDE} pixels, got {width} x {height}"
    return ""
