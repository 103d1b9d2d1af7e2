"""The cameras of a scene as single measurements see through them: the registered ones with their lens, where known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import distortion, undistort_rays
from splatnode.recon.metric.measurement import TWO_SIDED_95
from splatnode.recon.registration.straightened import radial_of
from splatnode.recon.result.snapshot import Snapshot

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MetricView:
    """A camera. Lengths in its picture count over the picture's longer side."""

    T_world_camera: Array  # (4, 4)
    focal: float
    radial: Array  # (2,) radial coefficients, as recon/registration/bundle.py has them
    shift: Array  # (2,) of the principal point from the middle of the picture
    bound: float  # 95 % bound of the centre's error, in the scene's unit; 0 where none is known

    @property
    def centre(self) -> Array:
        return self.T_world_camera[:3, 3]

    def unproject(self, pixels: Array, width: int, height: int) -> Array:
        """(M, 2) at depth 1 of pixels (M, 2) in a picture of this size."""
        side = max(width, height)
        distorted = ((pixels - np.array([width, height]) / 2.0) / side - self.shift) / self.focal
        return undistort_rays(distorted, self.radial)

    def project(self, points: Array, width: int, height: int) -> Array:
        """(M, 2) in a picture of this size of world points (M, 3); not a number behind the camera."""
        in_camera = (points - self.centre) @ self.T_world_camera[:3, :3]
        depth = np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)
        rays = in_camera[:, :2] / depth[:, None]
        distorted = self.focal * distortion((rays**2).sum(1), self.radial)[:, None] * rays + self.shift
        return max(width, height) * distorted + np.array([width, height]) / 2.0


def make_metric_views(snapshot: Snapshot) -> Mapping[str, MetricView]:
    """Makes the views by image name, in their order: as registered where that is known, else as published."""
    bounds = {camera.name: camera.bounds.centre if camera.bounds else 0.0 for camera in snapshot.cameras}
    found = {}
    for camera in sorted(snapshot.cameras, key=lambda camera: camera.frame_id):
        side, size = max(camera.width, camera.height), np.array([camera.width, camera.height])
        K = camera.K_photographed
        shift = (K[:2, 2] - size / 2.0) / side
        radial = np.array(radial_of(camera.lens))
        found[camera.name] = MetricView(
            camera.T_world_camera, float(K[0, 0]) / side, radial, shift, bounds[camera.name]
        )
    landmarks = snapshot.landmarks
    if landmarks is None:
        return found
    lenses = landmarks.lenses
    for index, name in enumerate(landmarks.names):
        if name in found:
            lens = float(lenses.focals[index]), lenses.radials[index], lenses.shifts[index]
            found[name] = MetricView(landmarks.Ts_world_camera[index], *lens, bounds[name])
    return found


def compute_scale_sigma(views: Sequence[MetricView]) -> float:
    """Standard deviation of log length that the cameras' bounds allow, by the two that are farthest apart; 0 of one."""
    if len(views) < 2:
        return 0.0
    first, second = max(combinations(views, 2), key=lambda pair: float(np.linalg.norm(pair[0].centre - pair[1].centre)))
    apart = float(np.linalg.norm(first.centre - second.centre))
    return math.hypot(first.bound, second.bound) / TWO_SIDED_95 / max(apart, 1e-12)
