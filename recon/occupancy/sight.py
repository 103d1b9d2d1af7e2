"""Sight: what one camera saw at depths that another photograph confirms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate

Float32 = npt.NDArray[np.float32]
UNBOUNDED = 0.01  # of a depth: what a camera may be off whose bounds nobody tells, as of one of a merged scene
DEPTH_ERROR = 0.02  # of a depth: as much confirmed depths may differ from each other (recon/priors/confirmed.py)


@dataclass(frozen=True, eq=False)
class DepthObservation:
    """Confirmed depths of a camera, and how wrong they may be."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3) of the depth's pixels
    depth: Float32  # (h, w) z in the camera's frame, 0 where nobody confirms one
    error: float = DEPTH_ERROR  # of a depth, relative: its own, and what the camera's bounds let it be off

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """(M, 3) world points of the pixels with a depth."""
        rows, columns = np.nonzero(self.depth)
        z = self.depth[rows, columns]
        x = (columns + 0.5 - self.K[0, 2]) / self.K[0, 0] * z
        y = (rows + 0.5 - self.K[1, 2]) / self.K[1, 1] * z
        in_camera = np.stack([x, y, z], 1)
        return in_camera @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def make_depth_observations(
    cameras: Sequence[CameraEstimate], depths: Mapping[str, npt.NDArray[np.float16]]
) -> list[DepthObservation]:
    """Makes the depth observations of cameras with depths. Raises ValueError where a depth does not fit its camera."""
    return [_make_depth_observation(camera, depths[camera.name]) for camera in cameras if camera.name in depths]


def _make_depth_observation(camera: CameraEstimate, depth: npt.NDArray[np.float16]) -> DepthObservation:
    reduction = max(1, round(camera.width / depth.shape[1]))
    if depth.shape != (camera.height // reduction, camera.width // reduction):
        raise ValueError(
            f"the depth of {camera.name} has {depth.shape[1]} x {depth.shape[0]} values, which fits no photograph of "
            f"{camera.width} x {camera.height} pixels: depth.npz is not of these cameras"
        )
    K = np.diag([1 / reduction, 1 / reduction, 1.0]) @ camera.K
    bounds = camera.bounds
    off = UNBOUNDED if bounds is None else bounds.centre_percent / 100.0 + math.radians(bounds.rotation_deg)
    return DepthObservation(camera.T_world_camera, K, depth.astype(np.float32), DEPTH_ERROR + off)
