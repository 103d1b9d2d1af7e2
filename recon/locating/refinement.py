"""The pose and the lens that fit correspondences best, and how well these determine them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.locating.camera_model import NUM_PARAMETERS, POSE, CameraModel, Lens
from splatnode.recon.locating.correspondences import Correspondences
from splatnode.recon.registration.cross_product import cross_matrix

Array = npt.NDArray[np.float64]

# Observations that tell as much as one with an error of its own: what lens, shutter and scene do otherwise than the
# model moves whole regions alike. Registration takes 100 (recon/registration/finishing.py); the landmarks have been
# through the same lenses and keep a part of it: with 30, 98 % of the turns are within their 95 % bounds (tests/bench).
CORRELATED = 30.0
_ROBUST = 3.0  # scale of the Cauchy loss, in standard deviations
_STEPS = 12  # Gauss-Newton converges in a few
_CONVERGED = 1e-6  # largest change of a parameter over its standard deviation, squared
_RAYLEIGH_MEDIAN = 1.1774  # median length of a 2D error whose components have sigma 1: sqrt(2 log 2)
_FIXED = 1e-9  # stands for a sigma of 0


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera with what its correspondences say of it."""

    camera: CameraModel
    covariance: Array  # (NUM_PARAMETERS, NUM_PARAMETERS) of `CameraModel.moved`'s step; NaN where it is not finite
    spread: float  # of the residuals, over what is expected of them: 1 where all is as it should be


def optimize_camera(camera: CameraModel, prior: Lens, known: Correspondences, noise_px: float) -> CameraFit:
    """The camera with the least robust cost, from `camera` on.

    `noise_px` is the standard deviation of a pixel's coordinate; the points' own uncertainty counts beside it. The
    lens is held near `prior`, by its sigmas.
    """
    information_of_prior = 1.0 / np.maximum(prior.sigmas, _FIXED) ** 2
    spread = 1.0
    covariance = np.full((NUM_PARAMETERS, NUM_PARAMETERS), np.nan)
    covariances = np.ascontiguousarray(known.covariances.transpose(1, 2, 0))
    for _ in range(_STEPS):
        rows, residuals = _whiten_residuals(camera, known, covariances, noise_px)
        lengths = np.hypot(*residuals)
        spread = max(_median(lengths) / _RAYLEIGH_MEDIAN, 1.0)
        weights = 1.0 / (1.0 + (lengths / (_ROBUST * spread)) ** 2) / spread**2
        across, down = weights * rows
        information = across @ rows[0].T + down @ rows[1].T
        gradient = across @ residuals[0] + down @ residuals[1]
        # The prior is one observation, and so are CORRELATED correspondences.
        lens = slice(POSE, NUM_PARAMETERS)
        information[lens, lens] += CORRELATED * np.diag(information_of_prior)
        gradient[lens] += CORRELATED * information_of_prior * (prior.values - camera.lens.values)
        inverse = _inverse(information)
        if inverse is None:
            return CameraFit(camera, np.full_like(covariance, np.nan), spread)
        step = inverse @ gradient
        if not np.isfinite(step).all():
            return CameraFit(camera, np.full_like(covariance, np.nan), spread)
        camera, covariance = camera.apply_step(step), CORRELATED * inverse
        if step @ information @ step < _CONVERGED:
            break
    return CameraFit(camera, covariance, spread)


def _whiten_residuals(
    camera: CameraModel,
    known: Correspondences,
    covariances: Array,  # (3, 3, M) of the points
    noise_px: float,
) -> tuple[Array, Array]:
    """Derivatives (2, NUM_PARAMETERS, M) and residuals (2, M), observed less predicted, in standard deviations."""
    by_parameters, by_point = (each.transpose(1, 2, 0) for each in camera.derivatives(known.points))
    residuals = (known.pixels - camera.project(known.points)[0]).T
    # The Cholesky factor of each pixel's covariance (2, 2).
    of_first, of_second = ((covariances * each[:, None]).sum(0) for each in by_point)
    top = np.sqrt((of_first * by_point[0]).sum(0) + noise_px**2)
    aside = (of_first * by_point[1]).sum(0) / top
    bottom = np.sqrt((of_second * by_point[1]).sum(0) + noise_px**2 - aside**2)
    rows, errors = np.empty_like(by_parameters), np.empty((2, len(known)))
    for whitened, given in ((rows, by_parameters), (errors, residuals)):
        whitened[0] = given[0] / top
        whitened[1] = (given[1] - aside * whitened[0]) / bottom
    return rows, errors


def _median(values: Array) -> float:
    """As NumPy's of (M,), in a fraction of its time for few."""
    middle = (len(values) - 1) // 2, len(values) // 2
    return float(np.partition(values, middle)[list(middle)].mean())


def _inverse(information: Array) -> Array | None:
    """(N, N) inverse of the normal matrix; None where it is not finite or no information at all."""
    unit = np.sqrt(np.diag(information))
    if not (np.isfinite(information).all() and (unit > 0).all()):
        return None
    try:
        return np.linalg.inv(information / unit[:, None] / unit) / unit[:, None] / unit
    except np.linalg.LinAlgError:
        return None


def pose_covariance(camera: CameraModel, covariance: Array) -> Array:
    """(6, 6) of a small motion in the camera's frame: translation (3), then rotation vector (3), radians.

    `covariance` (POSE, POSE or more) is of a step of `CameraModel.moved`.
    """
    change = np.zeros((POSE, POSE))
    change[:3, :3] = -cross_matrix(camera.translation[None])[0]
    change[:3, 3:] = -np.eye(3)
    change[3:, :3] = -np.eye(3)
    return change @ covariance[:POSE, :POSE] @ change.T
