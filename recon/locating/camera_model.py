"""A camera with an uncertain lens: where it sees points, and how that changes with its pose and its lens."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.recon.registration.cross_product import cross_matrix

Array = npt.NDArray[np.float64]

NUM_PARAMETERS = 10  # a small turn (3) and move (3) of the world in the camera, log focal, radial, shift (2)
POSE = 6  # of them, the pose's
_MIN_DEPTH = 1e-9
_UNDISTORT_ITERATIONS = 5


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens with what is known of it: standard deviations; 0 where a number is certain."""

    focal: float  # pixels
    radial: float  # first radial coefficient, as recon/registration/bundle.py has it
    shift: Array  # (2,) of the principal point, pixels
    log_focal_sigma: float
    radial_sigma: float
    shift_sigma: float  # pixels

    @property
    def values(self) -> Array:
        """(4,) as parameters."""
        return np.array([np.log(self.focal), self.radial, *self.shift])

    @property
    def sigmas(self) -> Array:
        """(4,)"""
        return np.array([self.log_focal_sigma, self.radial_sigma, self.shift_sigma, self.shift_sigma])


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A pose, world to camera, and a lens."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    lens: Lens

    def moved(self, step: Array) -> CameraModel:
        """With the parameters changed by `step` (NUM_PARAMETERS,)."""
        lens = self.lens
        return CameraModel(
            Rotation.from_rotvec(step[:3]).as_matrix() @ self.rotation,
            self.translation + step[3:POSE],
            replace(
                lens,
                focal=lens.focal * float(np.exp(step[6])),
                radial=lens.radial + step[7],
                shift=lens.shift + step[8:],
            ),
        )

    @property
    def T_world_camera(self) -> Array:
        """(4, 4)"""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.rotation.T, -self.rotation.T @ self.translation
        return T

    def errors(self, points: Array, pixels: Array) -> Array:
        """(M,) reprojection errors of points (M, 3), pixels; infinite behind the camera."""
        seen, depth = self.project(points)
        return np.where(depth > 0, np.linalg.norm(seen - pixels, axis=1), np.inf)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (M, 2) of world points (M, 3), relative to the nominal principal point, and depths (M,)."""
        in_camera = points @ self.rotation.T + self.translation
        rays = in_camera[:, :2] / _safe(in_camera[:, 2])[:, None]
        distortion = 1.0 + self.lens.radial * (rays**2).sum(1)
        return self.lens.focal * distortion[:, None] * rays + self.lens.shift, in_camera[:, 2]

    def derivatives(self, points: Array) -> tuple[Array, Array]:
        """Of the pixels of points (M, 3): (M, 2, NUM_PARAMETERS) by the parameters, (M, 2, 3) by the points."""
        turned = points @ self.rotation.T
        in_camera = turned + self.translation
        depth = _safe(in_camera[:, 2])
        rays = in_camera[:, :2] / depth[:, None]
        focal, radial, squared = self.lens.focal, self.lens.radial, (rays**2).sum(1)
        distortion = (1.0 + radial * squared)[:, None]
        by_ray = focal * (distortion[..., None] * np.eye(2) + 2.0 * radial * rays[:, :, None] * rays[:, None, :])
        ray_by_camera = np.zeros((len(points), 2, 3))
        ray_by_camera[:, 0, 0] = ray_by_camera[:, 1, 1] = 1.0 / depth
        ray_by_camera[:, :, 2] = -rays / depth[:, None]
        by_camera = by_ray @ ray_by_camera
        by_parameters = np.zeros((len(points), 2, NUM_PARAMETERS))
        by_parameters[:, :, :3] = -by_camera @ cross_matrix(turned)
        by_parameters[:, :, 3:POSE] = by_camera
        by_parameters[:, :, 6] = focal * distortion * rays
        by_parameters[:, :, 7] = focal * squared[:, None] * rays
        by_parameters[:, 0, 8] = by_parameters[:, 1, 9] = 1.0
        return by_parameters, by_camera @ self.rotation


def without_distortion(pixels: Array, lens: Lens) -> Array:
    """(M, 2) where a pinhole of the same focal length would see what `lens` sees at `pixels` (M, 2)."""
    distorted = (pixels - lens.shift) / lens.focal
    rays = distorted
    for _ in range(_UNDISTORT_ITERATIONS if lens.radial else 0):
        rays = distorted / (1.0 + lens.radial * (rays**2).sum(1))[:, None]
    return lens.focal * rays


def _safe(depth: Array) -> Array:
    return np.where(np.abs(depth) < _MIN_DEPTH, _MIN_DEPTH, depth)
