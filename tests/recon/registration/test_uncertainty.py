"""Sigmas against the errors of repeated estimates, measured as errors are: after the best similarity."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.recon.geometry import Similarity, align_cameras, angles_deg, umeyama
from splatnode.recon.registration import bundle_adjustment, incremental_mapper, registration, self_calibration
from splatnode.recon.registration.registration import make_registration
from splatnode.recon.result.verdict import compute_axes
from tests.recon.registration.test_bundle import NOISE_PX, PRIOR, problem
from tests.support.row_of_views import graph_of

CONFIG = bundle_adjustment.BundleAdjustmentConfig(
    robust_px=50.0, noise_px=NOISE_PX
)  # nearly squares, for which the covariance is exact
QUIET = bundle_adjustment.BundleAdjustmentConfig(
    robust_px=50.0, noise_px=0.05, tolerance=1e-9
)  # errors so small that they are linear in the noise
FIXED_LENS = bundle_adjustment.LensPrior(np.log([900.0]), np.zeros(1), np.zeros((1, 2)), np.zeros(1))
ALL = (0, 1, 2, 3)


def centres(of: bundle_adjustment.Problem) -> np.ndarray:
    return -np.einsum("cji,cj->ci", of.rotations, of.translations)


def test_sigmas_are_the_errors_of_repeated_estimates():
    estimates = [bundle_adjustment.adjust(problem(seed=seed), PRIOR, CONFIG) for seed in range(60)]
    covariance = bundle_adjustment.covariance(estimates[0], PRIOR, CONFIG)
    rotation_sigmas, centre_sigmas = bundle_adjustment.camera_sigmas(estimates[0], covariance, ALL)
    true = problem()
    spread = np.sqrt(((centres(true) - centres(true).mean(0)) ** 2).sum(1).mean())
    turned, moved = [], []
    for estimate in estimates:
        turns = np.einsum("cji,cjk->cik", estimate.rotations, true.rotations)
        vectors = np.stack([cv2.Rodrigues(turn)[0][:, 0] for turn in turns])
        turned.append(np.linalg.norm(vectors - vectors.mean(0), axis=1))
        fit = umeyama(centres(estimate), centres(true))
        aligned = fit(centres(estimate))
        moved.append(np.linalg.norm(aligned - centres(true), axis=1) / spread)
    np.testing.assert_allclose(rotation_sigmas, np.degrees(np.sqrt(np.mean(np.square(turned), 0))), rtol=0.3)
    np.testing.assert_allclose(centre_sigmas, np.sqrt(np.mean(np.square(moved), 0)), rtol=0.3)


def test_covariances_of_the_centres_are_those_of_repeated_estimates():
    true, covariance = far_away(0), bundle_adjustment.covariance(far_away(0), FIXED_LENS, QUIET)
    covariances = bundle_adjustment.centre_covariances(true, covariance, ALL)
    spread = np.sqrt(((centres(true) - centres(true).mean(0)) ** 2).sum(1).mean())
    _, sigmas = bundle_adjustment.camera_sigmas(true, covariance, ALL)
    np.testing.assert_allclose(np.sqrt(np.trace(covariances, axis1=1, axis2=2)), sigmas * spread, rtol=1e-9)
    estimates = [centres(bundle_adjustment.adjust(far_away(seed), FIXED_LENS, QUIET)) for seed in range(100)]
    errors = np.stack([umeyama(found, centres(true))(found) for found in estimates]) - centres(true)
    for of_camera, claimed in zip(errors.transpose(1, 0, 2), covariances, strict=True):
        found = of_camera.T @ of_camera / len(of_camera)
        assert np.trace(claimed) == pytest.approx(np.trace(found), rel=0.4)
        of_errors, of_claim = (np.linalg.eigh(each)[1][:, -1] for each in (found, claimed))
        assert abs(of_errors @ of_claim) > 0.9


def test_ellipsoids_of_cameras_that_know_their_depth_least_lie_along_the_view():
    """Translations are noisy along z of each camera, and centres so along its view; a similarity takes little out."""
    generator = np.random.default_rng(0)
    rotations = np.stack([cv2.Rodrigues(vector)[0] for vector in generator.normal(size=(30, 3))])
    ring = bundle_adjustment.make_empty_problem(
        rotations, generator.normal(size=(30, 3)), np.zeros(30, np.int64), np.zeros(1), *np.zeros((2, 1, 2))
    )
    of_pose = np.diag(np.square([0.0, 0.0, 0.0, 0.001, 0.001, 0.01]))
    covariance = bundle_adjustment.Covariance(np.kron(np.eye(30), of_pose), np.zeros(1))
    for rotation, of_centre in zip(
        rotations, bundle_adjustment.centre_covariances(ring, covariance, range(30)), strict=True
    ):
        longest, *others = np.array(compute_axes(of_centre, 0.02))
        assert abs(rotation[2] @ longest) > 0.95 * np.linalg.norm(longest)
        assert np.linalg.norm(longest) > 2.0 * max(np.linalg.norm(other) for other in others)


def test_the_covariances_are_in_the_frame_and_unit_of_the_world():
    """A model that was turned and scaled as a whole is the same registration."""
    true = far_away(0)
    turn = Similarity(3.0, cv2.Rodrigues(np.array([0.5, -1.0, 0.8]))[0], np.array([1.0, 2.0, 3.0]))
    rotations = true.rotations @ turn.rotation.T
    moved = replace(
        true,
        rotations=rotations,
        translations=-np.einsum("cij,cj->ci", rotations, turn(centres(true))),
        points=turn(true.points),
    )
    keyframes = graph_of(4).keyframes
    nothing = dict.fromkeys(("focal_sigma", "shift_sigma", "radial_sigma", "own_aspect_sigma", "skew_sigma"), 0.0)
    sure = self_calibration.OwnLensesConfig(**nothing)
    config = registration.RegistrationConfig(mapper=incremental_mapper.MapperConfig(own_lenses=sure))
    one, other = (
        make_registration(
            incremental_mapper.MapperResult(ALL, of, FIXED_LENS, QUIET, {}, 1.0, 0.3, 1), keyframes, [1.0] * 4, config
        )
        for of in (true, moved)
    )
    inside = bundle_adjustment.centre_covariances(true, bundle_adjustment.covariance(true, FIXED_LENS, QUIET), ALL)
    unit = np.linalg.norm(one.cameras[1].T_world_camera[:3, 3]) / np.linalg.norm(centres(true)[1] - centres(true)[0])
    for first, second, own in zip(one.cameras, other.cameras, inside, strict=True):
        np.testing.assert_allclose(first.centre_covariance, second.centre_covariance, rtol=0.01, atol=1e-9)
        np.testing.assert_allclose(first.centre_covariance, unit**2 * own, rtol=1e-6)  # the first camera is not turned


def far_away(seed: int) -> bundle_adjustment.Problem:
    """Cameras that all look along z at a cloud far away, with noisy pixels."""
    near = problem(seed=seed, noise_px=0.0)
    away = replace(
        near,
        rotations=np.tile(np.eye(3), (4, 1, 1)),
        translations=-centres(near),
        points=near.points + [0.0, 0.0, 20.0],
    )
    pixels, _ = bundle_adjustment.project(away)
    return replace(away, pixels=pixels + np.random.default_rng(seed).normal(size=pixels.shape) * QUIET.noise_px)


def test_it_does_not_matter_which_camera_is_held_still():
    found = bundle_adjustment.adjust(problem(), PRIOR, CONFIG)
    first = bundle_adjustment.camera_sigmas(found, bundle_adjustment.covariance(found, PRIOR, CONFIG, 0), ALL)
    third = bundle_adjustment.camera_sigmas(found, bundle_adjustment.covariance(found, PRIOR, CONFIG, 2), ALL)
    np.testing.assert_allclose(first[0], third[0], rtol=0.02)
    np.testing.assert_allclose(first[1], third[1], rtol=0.02)


def test_fewer_observations_make_a_camera_more_uncertain():
    whole = problem()
    few = (whole.camera_of != 2) | (whole.point_of < 8)
    thinned = replace(whole, camera_of=whole.camera_of[few], point_of=whole.point_of[few], pixels=whole.pixels[few])
    sigmas = []
    for of in (whole, thinned):
        found = bundle_adjustment.adjust(of, PRIOR, CONFIG)
        sigmas.append(bundle_adjustment.camera_sigmas(found, bundle_adjustment.covariance(found, PRIOR, CONFIG), ALL))
    assert sigmas[1][0].argmax() == 2
    assert sigmas[1][0][2] > 1.3 * sigmas[0][0][2]
    assert sigmas[1][1].max() > 1.2 * sigmas[0][1].max()


def test_cameras_that_are_not_registered_are_left_out():
    found = bundle_adjustment.adjust(problem(), PRIOR, CONFIG)
    rotations, positions = bundle_adjustment.camera_sigmas(
        found, bundle_adjustment.covariance(found, PRIOR, CONFIG), (0, 2, 3)
    )
    assert rotations.shape == positions.shape == (3,)
    assert rotations.min() > 0.0


def test_a_negative_or_infinite_variance_is_an_infinite_sigma():
    found = bundle_adjustment.sigmas(np.array([4.0, 0.0, -1e-12, np.nan, np.inf, -np.inf]))
    np.testing.assert_array_equal(found, [2.0, 0.0, np.inf, np.inf, np.inf, np.inf])


def test_a_camera_with_a_negative_variance_is_infinitely_uncertain():
    found = bundle_adjustment.adjust(problem(), PRIOR, CONFIG)
    covariance = bundle_adjustment.covariance(found, PRIOR, CONFIG)
    joint = covariance.joint.copy()
    joint[12:18, 12:18] -= 3.0 * np.diag(np.diag(joint[12:18, 12:18]))
    for sigmas in bundle_adjustment.camera_sigmas(found, replace(covariance, joint=joint), ALL):
        assert np.isinf(sigmas[2]) and not np.isnan(sigmas).any() and np.isfinite(sigmas).any()


@pytest.mark.parametrize("spoiled", ["joint", "rotations", "translations"])
def test_what_is_not_finite_makes_every_camera_infinitely_uncertain(spoiled):
    found = bundle_adjustment.adjust(problem(), PRIOR, CONFIG)
    covariance = bundle_adjustment.covariance(found, PRIOR, CONFIG)
    if spoiled == "joint":
        covariance = replace(covariance, joint=np.full_like(covariance.joint, np.nan))
    else:
        found = replace(found, **{spoiled: np.full_like(getattr(found, spoiled), np.inf)})
    for sigmas in bundle_adjustment.camera_sigmas(found, covariance, ALL):
        np.testing.assert_array_equal(sigmas, np.full(4, np.inf))


def test_a_point_that_is_not_finite_leaves_nothing_known():
    broken = problem()
    broken.points[3] = np.nan
    covariance = bundle_adjustment.covariance(broken, PRIOR, CONFIG)
    assert np.isnan(covariance.log_focals).all()
    for sigmas in bundle_adjustment.camera_sigmas(broken, covariance, ALL):
        np.testing.assert_array_equal(sigmas, np.full(4, np.inf))
    assert np.isnan(bundle_adjustment.centre_covariances(broken, covariance, ALL)).all()


def test_orientations_say_how_two_cameras_are_turned():
    """The centres of two cameras fit any similarity: errors are measured after the common turn, and so is the claim."""
    pair, true = [0, 2], problem()
    Ts_true = poses(true, pair)
    spread = 0.5 * np.linalg.norm(Ts_true[0, :3, 3] - Ts_true[1, :3, 3])
    estimates = [bundle_adjustment.adjust(problem(seed=seed), PRIOR, CONFIG) for seed in range(60)]
    covariance = bundle_adjustment.covariance(estimates[0], PRIOR, CONFIG)
    turned, moved = bundle_adjustment.camera_sigmas(estimates[0], covariance, pair)
    found = [poses(estimate, pair) for estimate in estimates]
    onto = [align_cameras(Ts, Ts_true) for Ts in found]
    turns = [angles_deg(to.rotation @ Ts[:, :3, :3], Ts_true[:, :3, :3]) for to, Ts in zip(onto, found, strict=True)]
    moves = [to(Ts[:, :3, 3]) - Ts_true[:, :3, 3] for to, Ts in zip(onto, found, strict=True)]
    np.testing.assert_allclose(turned, np.sqrt(np.mean(np.square(turns), 0)), rtol=0.3)
    np.testing.assert_allclose(moved, np.sqrt((np.square(moves)).sum(2).mean(0)) / spread, rtol=0.3)
    assert moved.min() > 1e-4


def poses(of: bundle_adjustment.Problem, cameras: list[int]) -> np.ndarray:
    """(N, 4, 4) of some cameras, camera to world."""
    Ts = np.tile(np.eye(4), (len(cameras), 1, 1))
    Ts[:, :3, :3], Ts[:, :3, 3] = of.rotations[cameras].transpose(0, 2, 1), centres(of)[cameras]
    return Ts
