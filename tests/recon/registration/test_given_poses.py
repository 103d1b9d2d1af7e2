"""Given poses in the bundle adjustment: against SciPy, and whether images contradict them no oftener than chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatnode.recon.registration import bundle_adjustment, posed_mapping
from tests.recon.registration.test_bundle import problem

NOISE_PX, SIGMAS = 0.5, np.array([np.radians(0.1), 0.004])
TOLD = bundle_adjustment.LensPrior(np.log([900.0]), np.zeros(1), np.zeros((1, 2)), np.zeros(1))
LOSS = bundle_adjustment.BundleAdjustmentConfig(robust_px=1e3, noise_px=NOISE_PX, tolerance=1e-12)


def given_poses(true: bundle_adjustment.Problem, seed: int) -> bundle_adjustment.GivenPoses:
    """Those of all cameras, as wrong as they are unsure."""
    generator, count = np.random.default_rng(seed), len(true.rotations)
    turns = Rotation.from_rotvec(generator.normal(size=(count, 3)) * SIGMAS[0]).as_matrix()
    centres = bundle_adjustment.centres(true) + generator.normal(size=(count, 3)) * SIGMAS[1]
    return bundle_adjustment.GivenPoses(turns @ true.rotations, centres, np.tile(SIGMAS, (count, 1)))


def start(true: bundle_adjustment.Problem, given: bundle_adjustment.GivenPoses) -> bundle_adjustment.Problem:
    translations = -np.einsum("cij,cj->ci", given.rotations, given.centres)
    return replace(true, rotations=given.rotations.copy(), translations=translations, given=given)


def adjusted(
    seed: int, false: tuple[int, float, float] | None = None
) -> tuple[bundle_adjustment.Problem, bundle_adjustment.Problem]:
    """The true problem, and the adjusted one, in which the pose of a camera may be false by radians and a length."""
    true = problem(40, seed, NOISE_PX)
    given = given_poses(true, 100 + seed)
    if false is not None:
        camera, turn, shift = false
        given.rotations[camera] = Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix() @ given.rotations[camera]
        given.centres[camera] += [0.0, shift, 0.0]
    return true, bundle_adjustment.adjust(start(true, given), TOLD, LOSS)


def test_the_adjustment_is_that_of_scipy() -> None:
    true = problem(12, 3, NOISE_PX)
    begun = start(true, given_poses(true, 4))
    given = begun.given
    assert given is not None
    found = bundle_adjustment.adjust(begun, TOLD, LOSS)

    def at(values: np.ndarray) -> bundle_adjustment.Problem:
        poses, points = values[:24].reshape(4, 6), values[24:].reshape(-1, 3)
        rotations = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ begun.rotations
        return replace(begun, rotations=rotations, translations=begun.translations + poses[:, 3:], points=points)

    def errors(values: np.ndarray) -> np.ndarray:
        now = at(values)
        turns = Rotation.from_matrix(now.rotations @ np.swapaxes(given.rotations, 1, 2)).as_rotvec()
        moves = bundle_adjustment.centres(now) - given.centres
        pixels = (bundle_adjustment.project(now)[0] - now.pixels) / NOISE_PX
        return np.concatenate([pixels.ravel(), turns.ravel() / SIGMAS[0], moves.ravel() / SIGMAS[1]])

    best = at(least_squares(errors, np.concatenate([np.zeros(24), true.points.ravel()]), method="lm", xtol=1e-12).x)
    np.testing.assert_allclose(bundle_adjustment.centres(found), bundle_adjustment.centres(best), atol=2e-5)
    np.testing.assert_allclose(found.rotations, best.rotations, atol=2e-5)


def test_a_camera_without_observations_stays_where_its_pose_is_given_as_sure_as_that() -> None:
    true = problem(30)
    begun = start(true, given_poses(true, 0))
    seen = true.camera_of != 3
    begun = replace(begun, camera_of=true.camera_of[seen], point_of=true.point_of[seen], pixels=true.pixels[seen])
    found = bundle_adjustment.adjust(begun, TOLD, LOSS)
    assert begun.given is not None
    np.testing.assert_allclose(found.rotations[3], begun.given.rotations[3], atol=1e-9)
    covariance = bundle_adjustment.covariance(found, TOLD, LOSS).cameras[3]
    np.testing.assert_allclose(np.diag(covariance)[:3], SIGMAS[0] ** 2, rtol=1e-3)


def test_errors_are_as_large_as_the_covariance_says_and_smaller_than_those_of_the_poses() -> None:
    squares, given_squares = [], []
    for seed in range(20):
        true, found = adjusted(seed)
        covariance = bundle_adjustment.covariance(found, TOLD, LOSS)
        assert found.given is not None
        for camera in range(4):
            turn, shift, by_pose = posed_mapping.deviation(
                found, replace(found.given, rotations=true.rotations, centres=bundle_adjustment.centres(true)), camera
            )
            error = np.concatenate([turn, shift])
            known = by_pose @ covariance.cameras[camera] @ by_pose.T
            squares.append(error @ np.linalg.solve(known, error) / 6)
        moved = bundle_adjustment.centres(found) - bundle_adjustment.centres(true)
        given_squares.append([(moved**2).sum(), ((found.given.centres - bundle_adjustment.centres(true)) ** 2).sum()])
    assert 0.75 < np.mean(squares) < 1.35
    ours, theirs = np.sum(given_squares, 0)
    assert ours < theirs


def test_true_poses_are_not_contradicted_and_their_residuals_are_what_chance_gives() -> None:
    probabilities = []
    for seed in range(25):
        _, found = adjusted(seed)
        assert found.given is not None
        residuals = posed_mapping.residuals(found, found.given, bundle_adjustment.covariance(found, TOLD, LOSS))
        probabilities += [each.probability for each in residuals.values()]
    assert len(probabilities) == 100
    assert min(probabilities) > posed_mapping.LEAST_PROBABILITY
    assert 0.35 < np.mean(probabilities) < 0.65


@pytest.mark.parametrize(("turn", "shift"), [(np.radians(3.0), 0.0), (0.0, 0.15)])
def test_a_false_pose_is_the_most_contradicted(turn: float, shift: float) -> None:
    _, found = adjusted(1, (2, turn, shift))
    assert found.given is not None
    residuals = posed_mapping.residuals(found, found.given, bundle_adjustment.covariance(found, TOLD, LOSS))
    worst = min(residuals, key=lambda camera: residuals[camera].probability)
    assert worst == 2
    assert residuals[worst].probability < posed_mapping.LEAST_PROBABILITY
    assert residuals[worst].sigmas > 3.9


@pytest.mark.parametrize("camera", [1, 2])
def test_a_residual_tells_where_images_have_the_camera_without_its_pose(camera: int) -> None:
    _, found = adjusted(1, (camera, np.radians(0.4), 0.01))
    given = found.given
    assert given is not None
    residual = posed_mapping.residuals(found, given, bundle_adjustment.covariance(found, TOLD, LOSS))[camera]
    freed = bundle_adjustment.adjust(replace(found, given=given.release([camera])), TOLD, LOSS)
    before, after = (np.concatenate(posed_mapping.deviation(each, given, camera)[:2]) for each in (found, freed))
    np.testing.assert_allclose(residual.without, after - before, atol=0.1 * np.abs(after - before).max())


def test_poses_whose_errors_depend_on_each_other_are_weighed_as_their_covariance_says() -> None:
    """As SciPy has it, with a joint covariance that ties the cameras together."""
    true = problem(12, 3, NOISE_PX)
    given = given_poses(true, 4)
    mixing = np.random.default_rng(5).normal(size=(24, 24)) / 10.0 + np.eye(24)
    scale = np.tile(np.repeat(SIGMAS, 3), 4)
    given = replace(given, joint=scale[:, None] * (mixing @ mixing.T) * scale)
    begun = replace(start(true, given), given=given)
    found = bundle_adjustment.adjust(begun, TOLD, LOSS)
    whiten = np.linalg.inv(np.linalg.cholesky(given.covariance))

    def errors(values: np.ndarray) -> np.ndarray:
        poses, points = values[:24].reshape(4, 6), values[24:].reshape(-1, 3)
        rotations = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ begun.rotations
        now = replace(begun, rotations=rotations, translations=begun.translations + poses[:, 3:], points=points)
        off = [np.concatenate(posed_mapping.deviation(now, given, camera)[:2]) for camera in range(4)]
        predicted, _ = bundle_adjustment.project(now)
        return np.concatenate([((predicted - now.pixels) / NOISE_PX).ravel(), whiten @ np.concatenate(off)])

    best = least_squares(errors, np.concatenate([np.zeros(24), begun.points.ravel()]), x_scale="jac", xtol=1e-14)
    turned = Rotation.from_rotvec(best.x[:24].reshape(4, 6)[:, :3]).as_matrix() @ begun.rotations
    np.testing.assert_allclose(found.rotations, turned, atol=2e-6)
    np.testing.assert_allclose(found.translations, begun.translations + best.x[:24].reshape(4, 6)[:, 3:], atol=2e-5)


@pytest.mark.parametrize(
    ("num_matches", "num_fit", "apart_deg", "contradicts"),
    [(62, 54, 3.0, True), (62, 54, 100.0, False), (300, 270, 100.0, True), (62, 30, 3.0, False)],
    ids=["a false pose", "the other wing of a castle", "poses that changed places", "matches that fit nothing"],
)
def test_few_matches_far_from_given_poses_are_repeated_structure(num_matches, num_fit, apart_deg, contradicts) -> None:
    assert posed_mapping.contradicts_poses(num_matches, num_fit, apart_deg) is contradicts
