"""A camera with an uncertain lens: where it sees points, and how that changes with its pose and its lens."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import distortion
from splatnode.recon.geometry import undistort_rays as straight

Array = npt.NDArray[np.float64]

# A small turn (3) and move (3) of the world in the camera, log focal, first radial, shift (2), log aspect.
NUM_PARAMETERS = 11
POSE = 6  # of them, the pose's
PINHOLE = 0.0, 0.0  # its radial coefficients
_MIN_DEPTH = 1e-9


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens with what is known of it: standard deviations; 0 where a number is certain."""

    focal: float  # pixels, the geometric mean of those across and down
    radial: tuple[float, float]  # radial coefficients, as recon/registration/bundle.py has them; the second is held
    shift: Array  # (2,) of the principal point, pixels
    log_focal_sigma: float
    radial_sigma: float  # of the first
    shift_sigma: float  # pixels
    log_aspect: float = 0.0  # logarithm of the focal length across over that down
    log_aspect_sigma: float = 0.0

    @property
    def values(self) -> Array:
        """(5,) as parameters."""
        return np.array([np.log(self.focal), self.radial[0], *self.shift, self.log_aspect])

    @property
    def sigmas(self) -> Array:
        """(5,)"""
        return np.array(
            [self.log_focal_sigma, self.radial_sigma, self.shift_sigma, self.shift_sigma, self.log_aspect_sigma]
        )

    @property
    def focals(self) -> Array:
        """(2,) focal lengths across and down, pixels."""
        half = 0.5 * self.log_aspect
        return self.focal * np.exp([half, -half])

    def copy_shape(self, other: Lens) -> Lens:
        """This lens with the radial coefficients and the aspect of `other`, known as well as these are."""
        return replace(
            self,
            radial=other.radial,
            radial_sigma=other.radial_sigma,
            log_aspect=other.log_aspect,
            log_aspect_sigma=other.log_aspect_sigma,
        )

    def copy_sigmas(self, other: Lens) -> Lens:
        """This lens, known as well as `other`."""
        return replace(
            self,
            log_focal_sigma=other.log_focal_sigma,
            radial_sigma=other.radial_sigma,
            shift_sigma=other.shift_sigma,
            log_aspect_sigma=other.log_aspect_sigma,
        )


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A pose, world to camera, and a lens."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    lens: Lens

    def apply_step(self, step: Array) -> CameraModel:
        """Returns the camera with its parameters changed by `step` (NUM_PARAMETERS,)."""
        lens = self.lens
        return CameraModel(
            np.asarray(cv2.Rodrigues(step[:3])[0]) @ self.rotation,
            self.translation + step[3:POSE],
            replace(
                lens,
                focal=lens.focal * float(np.exp(step[6])),
                radial=(lens.radial[0] + float(step[7]), lens.radial[1]),
                shift=lens.shift + step[8:10],
                log_aspect=lens.log_aspect + float(step[10]),
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
        bent = distortion((rays**2).sum(1), np.array(self.lens.radial))
        return self.lens.focals * bent[:, None] * rays + self.lens.shift, in_camera[:, 2]

    def derivatives(self, points: Array) -> tuple[Array, Array]:
        """Differentiates pixels of points (M, 3): (M, 2, NUM_PARAMETERS) by parameters, (M, 2, 3) by points."""
        # A row of memory is a derivative of all points: so NumPy's loops are long ones.
        turned = np.ascontiguousarray((points @ self.rotation.T).T)
        z = _safe(turned[2] + self.translation[2])
        x, y = (turned[0] + self.translation[0]) / z, (turned[1] + self.translation[1]) / z
        (across, down), (first, second), squared = self.lens.focals, self.lens.radial, x * x + y * y
        bent = distortion(squared, np.array(self.lens.radial))
        twice = 2.0 * (first + 2.0 * second * squared)
        # By the ray (x, y), which is the point over its depth; then by the point in the camera.
        xx, yy = across * (bent + twice * x * x), down * (bent + twice * y * y)
        xy, yx = across * twice * x * y, down * twice * x * y
        by_camera = np.stack([[xx, xy, -(xx * x + xy * y)], [yx, yy, -(yx * x + yy * y)]]) / z  # (2, 3, M)
        by_parameters = np.zeros((2, NUM_PARAMETERS, len(points)))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # turned x by_camera
            by_parameters[:, i] = turned[j] * by_camera[:, k] - turned[k] * by_camera[:, j]
        by_parameters[:, 3:POSE] = by_camera
        by_parameters[:, 6] = across * bent * x, down * bent * y
        by_parameters[:, 7] = across * squared * x, down * squared * y
        by_parameters[0, 8] = by_parameters[1, 9] = 1.0
        by_parameters[:, 10] = 0.5 * by_parameters[0, 6], -0.5 * by_parameters[1, 6]
        return by_parameters.transpose(2, 0, 1), (self.rotation.T @ by_camera).transpose(2, 0, 1)


def undistort_pixels(pixels: Array, lens: Lens) -> Array:
    """(M, 2) where a pinhole of the same focal length sees what `lens` sees at `pixels` (M, 2)."""
    distorted = (pixels - lens.shift) / lens.focals
    return lens.focal * straight(distorted, np.array(lens.radial))


def _safe(depth: Array) -> Array:
    return np.where(np.abs(depth) < _MIN_DEPTH, _MIN_DEPTH, depth)
