"""What is claimed of a placed camera: by its own points, and by how well the scene's own cameras are known."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from splatnode.recon.locating.camera_model import POSE
from splatnode.recon.locating.correspondences import Correspondences
from splatnode.recon.locating.outcome import NORMAL_95, LocalizationBounds
from splatnode.recon.locating.posing import PoseEstimate
from splatnode.recon.locating.refinement import pose_covariance
from splatnode.recon.result.bounds import compute_length_95
from splatnode.recon.result.landmarks import Landmarks

Array = npt.NDArray[np.float64]

_BALL_95 = 2.7955  # radius that holds 95 % of a normal distribution with sigma 1 in three dimensions
_MOST_LOG_FOCAL = math.log(10.0)  # who knows the focal length no better knows nothing


def compute_error_bounds(
    posed: PoseEstimate, known: Correspondences, landmarks: Landmarks, side: int
) -> tuple[LocalizationBounds, Array]:
    """The claim of an image whose longer side has `side` pixels.

    And the covariance (6, 6) of a small motion in the camera's frame: translation, then turn.

    The scene around the camera is as wrong as its cameras there: as those whose photographs it shares points with.
    """
    shares = np.bincount(known.photograph_of[posed.agreeing], minlength=len(landmarks.centre_bounds))
    shares = shares / max(shares.sum(), 1)
    turn = np.radians(np.sqrt(shares @ landmarks.rotation_bounds**2)) / _BALL_95
    move = np.sqrt(shares @ landmarks.centre_bounds**2) / _BALL_95
    covariance = pose_covariance(posed.fit.camera, posed.fit.covariance) + np.diag([move**2] * 3 + [turn**2] * 3)
    centre = compute_length_95(covariance[:3, :3])
    of_scene = 0.0 if landmarks.focal_bounds is None else np.sqrt(shares @ (landmarks.focal_bounds / 100.0) ** 2)
    of_lens = posed.fit.covariance[POSE:, POSE:]
    claim = LocalizationBounds(
        rotation_deg=math.degrees(compute_length_95(covariance[3:, 3:])),
        centre=centre,
        centre_percent=100.0 * centre / landmarks.unit,
        focal_percent=100.0 * math.expm1(min(math.hypot(_log_focal_bound(of_lens), of_scene), _MOST_LOG_FOCAL)),
        principal_percent=100.0 * compute_length_95(of_lens[2:4, 2:4]) / side,
    )
    return claim, covariance


def _log_focal_bound(of_lens: Array) -> float:
    """95 % bound of the logarithms of the focal lengths across and down, from the covariance (5, 5) of the lens."""
    variances = [
        np.array([1.0, half]) @ of_lens[np.ix_([0, 4], [0, 4])] @ np.array([1.0, half]) for half in (0.5, -0.5)
    ]
    return NORMAL_95 * math.sqrt(max(*variances, 0.0))
