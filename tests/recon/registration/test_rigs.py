"""Rigs in the bundle adjustment: against SciPy, and what they tell of cameras that moved or are given wrongly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatnode.recon.registration import bundle_adjustment
from splatnode.recon.registration.rig_constraint import RigConstraint
from tests.recon.registration.test_bundle import problem

NOISE_PX, SIGMAS = 0.5, np.array([np.radians(0.2), 0.01])
TOLD = bundle_adjustment.LensPrior(np.log([900.0]), np.zeros(1), np.zeros((1, 2)), np.zeros(1))
LOSS = bundle_adjustment.BundleAdjustmentConfig(robust_px=1e3, noise_px=NOISE_PX, tolerance=1e-12, max_iterations=200)


def two_sets(seed: int = 0) -> bundle_adjustment.Problem:
    """Cameras 0 and 1 took their images together, and 2 and 3: the second mount is that of camera 1, somewhat off."""
    true = problem(15, seed, NOISE_PX)
    X = true.rotations[1] @ true.rotations[0].T
    mounts = np.stack([np.eye(3), X])
    offsets = np.stack([np.zeros(3), true.translations[1] - X @ true.translations[0]])
    rig = RigConstraint(
        np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.tile(SIGMAS, (4, 1)),
        true.rotations[[0, 2]], true.translations[[0, 2]], mounts, offsets, np.array([True, False]),
        np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.full((2, 2), np.inf),
    )  # fmt: skip
    return replace(true, rig=rig)


def test_the_adjustment_on_a_rig_is_that_of_scipy() -> None:
    begun = two_sets()
    found = bundle_adjustment.adjust(begun, TOLD, LOSS)
    rig = begun.rig
    assert rig is not None and found.rig is not None
    count = len(begun.points)

    def at(values: np.ndarray) -> tuple[bundle_adjustment.Problem, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        steps = values[: 6 * 6].reshape(6, 6)
        turns, moves = Rotation.from_rotvec(steps[:, :3]).as_matrix(), steps[:, 3:]
        rotations = np.concatenate([begun.rotations[:1], turns[:3] @ begun.rotations[1:]])
        translations = np.concatenate([begun.translations[:1], begun.translations[1:] + moves[:3]])
        now = replace(
            begun, rotations=rotations, translations=translations, points=values[36:].reshape(count, 3), rig=None
        )
        of_sets = turns[3:5] @ rig.set_rotations, rig.set_translations + moves[3:5]
        mount = turns[5] @ rig.mount_rotations[1], rig.mount_translations[1] + moves[5]
        return now, *of_sets, *mount

    def errors(values: np.ndarray) -> np.ndarray:
        now, set_rotations, set_translations, mount_rotation, mount_translation = at(values)
        parts = [((bundle_adjustment.project(now)[0] - now.pixels) / NOISE_PX).ravel()]
        for camera in range(4):
            R, t = set_rotations[camera // 2], set_translations[camera // 2]
            if camera % 2:
                R, t = mount_rotation @ R, mount_rotation @ t + mount_translation
            turn = now.rotations[camera] @ R.T
            parts.append(Rotation.from_matrix(turn).as_rotvec() / SIGMAS[0])
            parts.append((now.translations[camera] - turn @ t) / SIGMAS[1])
        return np.concatenate(parts)

    start = np.concatenate([np.zeros(36), begun.points.ravel()])
    best, set_rotations, _, mount_rotation, mount_translation = at(
        least_squares(errors, start, method="lm", xtol=1e-12).x
    )
    # A turn's deviation is linearised: these turn by degrees
    np.testing.assert_allclose(bundle_adjustment.centres(found), bundle_adjustment.centres(best), atol=2e-3)
    np.testing.assert_allclose(found.rig.mount_rotations[1], mount_rotation, atol=1e-3)
    np.testing.assert_allclose(found.rig.mount_translations[1], mount_translation, atol=3e-3)
    np.testing.assert_allclose(found.rig.set_rotations, set_rotations, atol=1e-3)
