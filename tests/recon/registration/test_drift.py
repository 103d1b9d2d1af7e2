"""The covariance of poses that drift, against samples of odometry that is wrong at each step."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from splatnode.recon.registration import bundle_adjustment
from splatnode.recon.registration.known_poses import Drift, compute_drift_covariance
from splatnode.recon.registration.posed_mapping import compute_scale_sigma

DRIFT = Drift(0.02, 0.3)


def way(count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Cameras on an arc: world to camera, and centres in metres."""
    angles = np.linspace(0.0, 1.2, count)
    rotations = Rotation.from_rotvec(-angles[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    return rotations, np.stack([2.0 * np.sin(angles), 0.1 * angles, 2.0 * np.cos(angles)], 1)


def drifted(rotations: np.ndarray, centres: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """(6 C,) errors in the cameras' axes of odometry that adds up wrong steps, as a bundle adjustment sees them."""
    scale = 1.0 + DRIFT.share * generator.normal()
    told_rotation, told_centre, found = rotations[0], centres[0], [np.zeros(6)]
    for i in range(1, len(centres)):
        step = centres[i] - centres[i - 1]
        length = np.linalg.norm(step)
        in_camera = rotations[i - 1] @ step * scale + DRIFT.share * length * generator.normal(size=3)
        told_centre = told_centre + told_rotation.T @ in_camera
        turn = Rotation.from_rotvec(np.radians(DRIFT.degrees) * np.sqrt(length) * generator.normal(size=3))
        told_rotation = turn.as_matrix() @ rotations[i] @ rotations[i - 1].T @ told_rotation
        off = Rotation.from_matrix(rotations[i] @ told_rotation.T).as_rotvec()
        found.append(np.concatenate([off, rotations[i] @ (told_centre - centres[i])]))
    return np.concatenate(found)


def test_the_covariance_is_that_of_odometry_which_adds_up_its_steps() -> None:
    rotations, centres = way()
    generator = np.random.default_rng(0)
    samples = np.stack([drifted(rotations, centres, generator) for _ in range(3000)])
    found, true = compute_drift_covariance(rotations, centres, DRIFT)[6:, 6:], np.cov(samples[:, 6:].T)
    sigmas = np.sqrt(np.diag(true))
    np.testing.assert_allclose(np.sqrt(np.diag(found)), sigmas, rtol=0.06)
    assert np.abs((found - true) / sigmas / sigmas[:, None]).max() < 0.08


def test_the_scale_is_known_as_well_as_the_lengths_of_the_steps() -> None:
    rotations, centres = way()
    joint = compute_drift_covariance(rotations, centres, DRIFT) + 1e-8 * np.eye(30)
    given = bundle_adjustment.GivenPoses(rotations, centres, np.full((5, 2), 0.01), joint)
    assert DRIFT.share < compute_scale_sigma(given) < 1.5 * DRIFT.share
    alone = bundle_adjustment.GivenPoses(rotations, centres, np.full((5, 2), 0.01))
    spread = np.sqrt(((centres - centres.mean(0)) ** 2).sum())
    assert np.isclose(compute_scale_sigma(alone), 0.01 / spread, rtol=0.2)
