"""A camera as a program sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.capture.stamp import Stamp
from splatnode.recon.result.bounds import Bounds, compute_covariance
from splatnode.recon.result.snapshot import CameraEstimate

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera of the result: its pose, its lens, and how well they are known.

    Axes are OpenCV's: x right, y down, z forward. The world is the frame of the first camera that was placed; its unit
    is the metre where `Result.metric` is set, and none otherwise.
    """

    name: str  # of the photograph: its file's, or 0000.png, 0001.png, ... where it came as an array
    T_world_camera: Array  # (4, 4) p_world = T_world_camera @ p_camera
    K: Array  # (3, 3) of the photograph at `width` x `height`, without distortion; the top-left pixel is at (0.5, 0.5)
    width: int  # of the photograph as the scene was fitted to it, pixels
    height: int  # likewise, pixels
    # As it was given; or estimated with a distortion that was taken out of the photograph. None: estimated, without any
    lens: Intrinsics | None = None
    bounds: Bounds | None = None  # the claim: its errors are smaller with 95 %; None: nothing is claimed
    captured_at: Stamp | None = None  # nanoseconds, and of which clock; None: nobody knows
    # Share of the photograph's pixels, 0 to 1, whose depth is multi-view consistent: another view has the same point.
    # None: not known, as of a coarse preview
    consistent_depth: float | None = None

    @property
    def T_camera_world(self) -> Array:
        """(4, 4) p_camera = T_camera_world @ p_world."""
        R, t = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        inverse = np.eye(4)
        inverse[:3, :3], inverse[:3, 3] = R.T, -R.T @ t
        return inverse

    @property
    def centre(self) -> Array:
        """(3,) where it stood, in the world."""
        return self.T_world_camera[:3, 3].copy()

    @property
    def covariance(self) -> Array | None:
        """(3, 3) of its centre, in the world's axes and squared unit, whose 95 % ellipsoid is that of the claim."""
        return None if self.bounds is None else compute_covariance(self.bounds.axes)


def camera_of(estimate: CameraEstimate, lens: Intrinsics | None = None) -> Camera:
    """A camera of a result or a node, with the lens that was given for its photograph."""
    return Camera(
        name=estimate.name,
        T_world_camera=estimate.T_world_camera.copy(),
        K=estimate.K.copy(),
        width=estimate.width,
        height=estimate.height,
        lens=lens or estimate.lens,
        bounds=estimate.bounds,
        captured_at=estimate.captured_at,
        consistent_depth=estimate.consistent_depth,
    )
