"""Pointmap: what every prior gives for a keyframe, in one world frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class Pointmap:
    """A 3D point and a confidence for every pixel of a keyframe at modelled size, with the camera that saw them."""

    name: str
    frame_id: int
    depth: npt.NDArray[np.float32]  # (h, w) z in the camera frame, 0 where unknown
    confidence: npt.NDArray[np.float32]  # (h, w) in [0, 1], 0 where unknown
    normal: npt.NDArray[np.float32]  # (h, w, 3) camera frame, unit length, facing the camera; any where depth is 0
    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3) at modelled size
    # (h, w) z that other views have not confirmed or denied yet, 0 where unknown: what further views are compared with
    unchecked: npt.NDArray[np.float16] | None = None

    @property
    def points(self) -> npt.NDArray[np.float32]:
        """(h, w, 3) world points; the camera's centre where the depth is unknown."""
        return compute_world_points(self.depth, self.T_world_camera, self.K)

    def apply_mask(self, keep: npt.NDArray[np.bool_]) -> Pointmap:
        """The point map with depth and confidence 0, which is unknown, outside the mask `keep` (h, w).

        It shares what the mask does not change: a hundred point maps at a time are most of the memory that is held.
        """
        if keep.all():
            return self
        return replace(self, depth=self.depth * keep, confidence=self.confidence * keep)

    def apply_image_mask(self, mask: npt.NDArray[np.bool_] | None) -> Pointmap:
        """As `apply_mask` by the mask (h, w) of the photograph, whose pixels confirm and deny nothing either."""
        if mask is None:
            return self
        unchecked = None if self.unchecked is None else self.unchecked * mask
        return replace(self.apply_mask(mask), unchecked=unchecked)


def compute_world_points(
    depth: npt.NDArray[np.float32],  # (h, w) z in the camera frame
    T_world_camera: npt.NDArray[np.float64],  # (4, 4)
    K: npt.NDArray[np.float64],  # (3, 3)
) -> npt.NDArray[np.float32]:
    """(h, w, 3) world points that a camera's pixels show; the camera's centre where the depth is 0."""
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    camera_points = rays * depth[..., None]
    return (camera_points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]).astype(np.float32)
