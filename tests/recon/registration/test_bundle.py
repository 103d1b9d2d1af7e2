"""Bundle adjustment against SciPy, known answers, and the covariance against repeated draws of the noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from splatnode.recon.core import default_threads, set_threads
from splatnode.recon.registration import bundle_adjustment

NOISE_PX = 0.3
PRIOR = bundle_adjustment.LensPrior(np.log([950.0]), np.array([0.3]), np.array([[0.1, 0.05]]), np.array([10.0]))


def problem(num_points: int = 60, seed: int = 0, noise_px: float = NOISE_PX) -> bundle_adjustment.Problem:
    """Four cameras around a cloud of points, their true parameters, and noisy pixels."""
    generator = np.random.default_rng(seed)
    points = np.random.default_rng(7).uniform(-1.5, 1.5, (num_points, 3)) + [0.0, 0.0, 5.0]
    vectors = np.array([[0, 0, 0], [0.02, 0.3, 0.01], [-0.15, -0.2, 0.05], [0.1, 0.1, -0.1]])
    rotations = np.stack([cv2.Rodrigues(vector)[0] for vector in vectors])
    centres = np.array([[0, 0, 0], [1.4, 0.1, 0.2], [-1.1, 0.6, 0.1], [0.5, -0.9, -0.4]])
    camera_of, point_of = np.tile(np.arange(4), num_points), np.repeat(np.arange(num_points), 4)
    true = bundle_adjustment.Problem(
        rotations=rotations,
        translations=-np.einsum("cij,cj->ci", rotations, centres),
        lens_of_camera=np.zeros(4, np.int64),
        log_focals=np.log([900.0]),
        radials=np.array([[0.03, -0.02]]),
        shifts=np.array([[4.0, -3.0]]),
        points=points,
        camera_of=camera_of,
        point_of=point_of,
        pixels=np.zeros((len(camera_of), 2)),
    )
    pixels, depths = bundle_adjustment.project(true)
    assert (depths > 0).all()
    return replace(true, pixels=pixels + generator.normal(size=pixels.shape) * noise_px)


def disturbed(true: bundle_adjustment.Problem, seed: int = 1) -> bundle_adjustment.Problem:
    """The problem with parameters off by what a first estimate is off; camera 0 as it was."""
    generator = np.random.default_rng(seed)
    turns = np.stack([cv2.Rodrigues(vector)[0] for vector in generator.normal(size=(4, 3)) * 0.02])
    turns[0] = np.eye(3)
    moves = generator.normal(size=(4, 3)) * 0.03
    moves[0] = 0.0
    return replace(
        true,
        rotations=turns @ true.rotations,
        translations=true.translations + moves,
        log_focals=true.log_focals + 0.1,
        radials=np.zeros((1, 2)),
        shifts=np.zeros((1, 2)),
        points=true.points + generator.normal(size=true.points.shape) * 0.05,
    )


def turned_deg(one: bundle_adjustment.Problem, other: bundle_adjustment.Problem) -> float:
    cosine = (np.einsum("cij,cij->c", one.rotations, other.rotations) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())


def test_a_centre_is_where_its_camera_has_the_origin():
    known = problem(num_points=3)
    centres = bundle_adjustment.centres(known)
    assert np.abs(centres).max() > 1.0
    moved = np.einsum("cij,cj->ci", known.rotations, centres) + known.translations
    np.testing.assert_allclose(moved, 0.0, atol=1e-12)


def test_a_point_behind_a_camera_has_an_infinite_error_wherever_it_is_projected():
    exact = problem(num_points=3, noise_px=0.0)
    assert bundle_adjustment.reprojection_errors(exact).max() < 1e-9
    mirrored = replace(exact, points=exact.points * [[1.0], [-1.0], [1.0]])  # the world's frame is camera 0's
    errors = bundle_adjustment.reprojection_errors(mirrored).reshape(3, 4)
    assert np.isinf(errors[1]).all() and np.isfinite(errors[[0, 2]]).all()
    assert errors[[0, 2]].max() < 1e-9


def test_what_was_disturbed_comes_back_exactly_without_noise():
    true = problem(noise_px=0.0)
    prior = replace(PRIOR, sigmas=np.array([1e3]), radial_sigmas=np.full((1, 2), 1e3), shift_sigmas=np.array([1e6]))
    found = bundle_adjustment.adjust(
        disturbed(true), prior, bundle_adjustment.BundleAdjustmentConfig(tolerance=1e-14, max_iterations=200)
    )
    assert bundle_adjustment.reprojection_errors(found).max() < 1e-4
    assert turned_deg(found, true) < 1e-4
    assert np.exp(found.log_focals[0]) == pytest.approx(900.0, abs=0.01)
    np.testing.assert_allclose(found.radials[0], [0.03, -0.02], atol=1e-4)
    np.testing.assert_allclose(found.shifts[0], [4.0, -3.0], atol=0.01)


def test_scipy_finds_no_lower_cost_from_where_it_ends():
    config = bundle_adjustment.BundleAdjustmentConfig(robust_px=0.5, tolerance=1e-12, max_iterations=200)
    found = bundle_adjustment.adjust(disturbed(problem(num_points=20)), PRIOR, config)

    def moved(step: np.ndarray) -> bundle_adjustment.Problem:
        poses = step[:18].reshape(3, 6)
        rotations, translations = found.rotations.copy(), found.translations.copy()
        for camera, pose in enumerate(poses, start=1):
            rotations[camera] = cv2.Rodrigues(pose[:3].copy())[0] @ rotations[camera]
            translations[camera] += pose[3:]
        return replace(
            found,
            rotations=rotations,
            translations=translations,
            log_focals=found.log_focals + step[18],
            radials=found.radials + step[19:21],
            shifts=found.shifts + step[21:23],
            points=found.points + step[23:].reshape(-1, 3),
        )

    def cost(step: np.ndarray) -> float:
        at = moved(step)
        pulls = (
            ((at.log_focals - PRIOR.log_focals) / PRIOR.sigmas) ** 2
            + ((at.radials / PRIOR.radial_sigmas) ** 2).sum(1)
            + ((at.shifts / PRIOR.shift_sigmas[:, None]) ** 2).sum(1)
        )
        return bundle_adjustment.robust_cost(at, config) + float(pulls.sum())

    def residuals(step: np.ndarray) -> np.ndarray:
        return np.sqrt([cost(step)])  # its square is the cost

    start = cost(np.zeros(23 + 60))
    gradient = np.array([(cost(d) - cost(-d)) / 2e-6 for d in np.eye(83) * 1e-6])
    at_start = bundle_adjustment.robust_cost(disturbed(problem(num_points=20)), config)
    assert np.abs(gradient).max() < 1e-3 * at_start
    polished = least_squares(residuals, np.zeros(83), max_nfev=20)
    assert start <= 2.0 * polished.cost * (1.0 + 1e-6)


def test_outliers_hardly_move_the_cameras():
    clean = problem()
    wrong = np.random.default_rng(3).random(len(clean.pixels)) < 0.1
    spoiled = replace(clean, pixels=clean.pixels + wrong[:, None] * [80.0, -50.0])
    found = bundle_adjustment.adjust(disturbed(spoiled), PRIOR, bundle_adjustment.BundleAdjustmentConfig())
    assert turned_deg(found, clean) < 0.3


def test_a_sigma_of_zero_fixes_a_parameter():
    start = disturbed(problem())
    found = bundle_adjustment.adjust(
        start,
        replace(PRIOR, sigmas=np.zeros(1), radial_sigmas=np.zeros((1, 2))),
        bundle_adjustment.BundleAdjustmentConfig(),
    )
    assert found.log_focals[0] == start.log_focals[0]
    assert not found.radials.any()
    assert np.abs(found.shifts).max() > 0.0
    np.testing.assert_array_equal(found.rotations[0], start.rotations[0])


def test_the_argument_is_left_alone_and_the_number_of_threads_does_not_matter():
    start = disturbed(problem())
    kept = start.points.copy()
    results = []
    for threads in (3, 1):
        set_threads(threads)
        results.append(bundle_adjustment.adjust(start, PRIOR, bundle_adjustment.BundleAdjustmentConfig()))
    set_threads(default_threads())
    np.testing.assert_array_equal(start.points, kept)
    np.testing.assert_array_equal(results[0].points, results[1].points)
    np.testing.assert_array_equal(results[0].rotations, results[1].rotations)


def test_the_order_of_observations_does_not_matter():
    start = disturbed(problem())
    order = np.random.default_rng(0).permutation(len(start.pixels))
    shuffled = replace(
        start, camera_of=start.camera_of[order], point_of=start.point_of[order], pixels=start.pixels[order]
    )
    one, other = (
        bundle_adjustment.adjust(case, PRIOR, bundle_adjustment.BundleAdjustmentConfig()) for case in (start, shuffled)
    )
    assert turned_deg(one, other) < 1e-4


def test_covariance_is_the_spread_of_the_estimates():
    # Nearly squares, for which the covariance is exact.
    config = bundle_adjustment.BundleAdjustmentConfig(robust_px=50.0, noise_px=NOISE_PX)
    estimates = [bundle_adjustment.adjust(problem(seed=seed), PRIOR, config) for seed in range(60)]
    predicted = bundle_adjustment.covariance(estimates[0], PRIOR, config)
    true = problem()
    turns = np.stack([cv2.Rodrigues(e.rotations[2] @ true.rotations[2].T)[0][:, 0] for e in estimates])
    spread = np.sqrt(np.trace(np.cov(turns.T)))
    assert np.sqrt(np.trace(predicted.cameras[2][:3, :3])) == pytest.approx(spread, rel=0.3)
    log_focals = np.array([e.log_focals[0] for e in estimates])
    assert np.sqrt(predicted.log_focals[0]) == pytest.approx(log_focals.std(), rel=0.3)
    assert np.abs(predicted.cameras[0]).max() == 0.0
