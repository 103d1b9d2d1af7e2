"""Whether images contradict given poses: the residual of each pose against all others, beyond both sigmas.

A pose g with covariance S holds its camera; the adjustment puts that at x with covariance C, in which g counts. Then
x - g has the covariance S - C, whatever else is known, so that no adjustment without g is needed (Cook and Weisberg,
"Residuals and influence in regression", 1982, 2.2). Directions that images do not tell do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from splatnode.recon.registration import bundle_adjustment

Array = npt.NDArray[np.float64]

# Of a false alarm: 4.4 sigmas. What is named wrongly among a thousand poses is what the sigmas do not tell
LEAST_PROBABILITY = 1e-5
_TOLD = 0.05  # least share of a pose's variance that images must take away for a direction to count
_SMALLEST = 1e-300  # of a probability, whose sigmas are finite


@dataclass(frozen=True, eq=False)
class Residual:
    """How far a camera is from its given pose."""

    turn: Array  # (3,) radians, about the camera's axes
    shift: Array  # (3,) along them, in the problem's unit
    probability: float  # that an error as large comes by chance; 1 where images tell nothing
    squared: float = 0.0  # its length in its own sigmas, squared: by how much the cost falls without the pose

    @property
    def sigmas(self) -> float:
        """The deviation of a normal variable that is as unlikely."""
        return float(norm.isf(max(self.probability, _SMALLEST) / 2.0))


def residuals(
    problem: bundle_adjustment.Problem, given: bundle_adjustment.GivenPoses, covariance: bundle_adjustment.Covariance
) -> dict[int, Residual]:
    """Computes the residual of each camera that `given` has a pose of and `covariance` is finite for.

    Where `problem.given` holds a camera, its residual is against all others; where not, against the images alone.
    """
    held = np.zeros(len(given.sigmas), bool) if problem.given is None else problem.given.is_held
    blocks, found, priors = covariance.cameras, {}, given.covariance
    for camera in np.flatnonzero(given.is_held).tolist():
        if not np.isfinite(blocks[camera]).all() or not blocks[camera].any():
            continue
        turn, shift, by_pose = deviation(problem, given, camera)
        own = slice(6 * camera, 6 * camera + 6)
        whiten = np.linalg.inv(np.linalg.cholesky(priors[own, own]))
        error = whiten @ np.concatenate([turn, shift])
        known = whiten @ by_pose @ blocks[camera] @ by_pose.T @ whiten.T
        of_residual = np.eye(6) - known if held[camera] else np.eye(6) + known
        variances, directions = np.linalg.eigh((of_residual + of_residual.T) / 2.0)
        counts = variances > _TOLD
        squared = float(((directions.T @ error)[counts] ** 2 / variances[counts]).sum())
        probability = float(chi2.sf(squared, counts.sum())) if counts.any() else 1.0
        found[camera] = Residual(turn, shift, probability, squared)
    return found


def deviation(
    problem: bundle_adjustment.Problem, given: bundle_adjustment.GivenPoses, camera: int
) -> tuple[Array, Array, Array]:
    """Turn (3,) and shift (3,) of a camera from its given pose, and their derivatives (6, 6) by the camera's pose."""
    rotation = problem.rotations[camera]
    turn = Rotation.from_matrix(rotation @ given.rotations[camera].T).as_rotvec()
    x, y, z = seen = rotation @ given.centres[camera]
    by_pose = np.eye(6)
    by_pose[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return turn, seen + problem.translations[camera], by_pose
