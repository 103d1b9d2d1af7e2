"""Pointmap: what every prior gives for a keyframe, in one world frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class Pointmap:
    """A 3D point and a confidence for every pixel of a keyframe at modelled size, with the camera that saw them."""

    name: str
    frame_id: int
    depth: npt.NDArray[np.float32]  # (h, w) z in the camera frame, 0 where unknown
    confidence: npt.NDArray[np.float32]  # (h, w) in [0, 1], 0 where unknown
    normal: npt.NDArray[np.float32]  # (h, w, 3) camera frame, unit length, facing the camera, 0 where unknown
    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3) at modelled size

    @property
    def points(self) -> npt.NDArray[np.float32]:
        """(h, w, 3) world points; the camera's centre where the depth is unknown."""
        height, width = self.depth.shape
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack([(u - self.K[0, 2]) / self.K[0, 0], (v - self.K[1, 2]) / self.K[1, 1], np.ones_like(u)], -1)
        camera_points = rays * self.depth[..., None]
        return (camera_points @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]).astype(np.float32)


def project_points(
    points: npt.NDArray[np.floating], target: Pointmap
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """Where world points (M, 3) fall in the target's image: flat pixel index (M,), -1 outside, and depth (M,)."""
    to_camera = np.linalg.inv(target.T_world_camera).astype(np.float32)
    in_camera = points.astype(np.float32) @ to_camera[:3, :3].T + to_camera[:3, 3]
    depth = in_camera[:, 2]
    safe = np.where(depth > 1e-6, depth, np.float32(np.inf))
    K = target.K.astype(np.float32)
    u = np.floor(in_camera[:, 0] / safe * K[0, 0] + K[0, 2])
    v = np.floor(in_camera[:, 1] / safe * K[1, 1] + K[1, 2])
    height, width = target.depth.shape
    inside = (depth > 1e-6) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return np.where(inside, v * width + u, -1).astype(np.int64), depth
