"""Sigmas against the errors of repeated estimates, measured as errors are: after the best similarity."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.recon.evaluate.camera_errors import umeyama
from splatnode.recon.registration import bundle, uncertainty
from tests.recon.registration.test_bundle import NOISE_PX, PRIOR, problem

CONFIG = bundle.Config(robust_px=50.0, noise_px=NOISE_PX)  # nearly squares, for which the covariance is exact
ALL = (0, 1, 2, 3)


def centres(of: bundle.Problem) -> np.ndarray:
    return -np.einsum("cji,cj->ci", of.rotations, of.translations)


def test_sigmas_are_the_errors_of_repeated_estimates():
    estimates = [bundle.adjust(problem(seed=seed), PRIOR, CONFIG) for seed in range(60)]
    covariance = bundle.covariance(estimates[0], PRIOR, CONFIG)
    rotation_sigmas, centre_sigmas = uncertainty.camera_sigmas(estimates[0], covariance, ALL)
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


def test_it_does_not_matter_which_camera_is_held_still():
    found = bundle.adjust(problem(), PRIOR, CONFIG)
    first = uncertainty.camera_sigmas(found, bundle.covariance(found, PRIOR, CONFIG, 0), ALL)
    third = uncertainty.camera_sigmas(found, bundle.covariance(found, PRIOR, CONFIG, 2), ALL)
    np.testing.assert_allclose(first[0], third[0], rtol=0.02)
    np.testing.assert_allclose(first[1], third[1], rtol=0.02)


def test_fewer_observations_make_a_camera_more_uncertain():
    whole = problem()
    few = (whole.camera_of != 2) | (whole.point_of < 8)
    thinned = replace(whole, camera_of=whole.camera_of[few], point_of=whole.point_of[few], pixels=whole.pixels[few])
    sigmas = []
    for of in (whole, thinned):
        found = bundle.adjust(of, PRIOR, CONFIG)
        sigmas.append(uncertainty.camera_sigmas(found, bundle.covariance(found, PRIOR, CONFIG), ALL))
    assert sigmas[1][0].argmax() == 2
    assert sigmas[1][0][2] > 1.3 * sigmas[0][0][2]
    assert sigmas[1][1].max() > 1.2 * sigmas[0][1].max()


def test_cameras_that_are_not_registered_are_left_out():
    found = bundle.adjust(problem(), PRIOR, CONFIG)
    rotations, positions = uncertainty.camera_sigmas(found, bundle.covariance(found, PRIOR, CONFIG), (0, 2, 3))
    assert rotations.shape == positions.shape == (3,)
    assert rotations.min() > 0.0


def test_a_negative_or_infinite_variance_is_an_infinite_sigma():
    found = uncertainty.sigmas(np.array([4.0, 0.0, -1e-12, np.nan, np.inf, -np.inf]))
    np.testing.assert_array_equal(found, [2.0, 0.0, np.inf, np.inf, np.inf, np.inf])


def test_a_camera_with_a_negative_variance_is_infinitely_uncertain():
    found = bundle.adjust(problem(), PRIOR, CONFIG)
    covariance = bundle.covariance(found, PRIOR, CONFIG)
    joint = covariance.joint.copy()
    joint[12:18, 12:18] -= 3.0 * np.diag(np.diag(joint[12:18, 12:18]))
    for sigmas in uncertainty.camera_sigmas(found, replace(covariance, joint=joint), ALL):
        assert np.isinf(sigmas[2]) and not np.isnan(sigmas).any() and np.isfinite(sigmas).any()


@pytest.mark.parametrize("spoiled", ["joint", "rotations", "translations"])
def test_what_is_not_finite_makes_every_camera_infinitely_uncertain(spoiled):
    found = bundle.adjust(problem(), PRIOR, CONFIG)
    covariance = bundle.covariance(found, PRIOR, CONFIG)
    if spoiled == "joint":
        covariance = replace(covariance, joint=np.full_like(covariance.joint, np.nan))
    else:
        found = replace(found, **{spoiled: np.full_like(getattr(found, spoiled), np.inf)})
    for sigmas in uncertainty.camera_sigmas(found, covariance, ALL):
        np.testing.assert_array_equal(sigmas, np.full(4, np.inf))


def test_a_point_that_is_not_finite_leaves_nothing_known():
    broken = problem()
    broken.points[3] = np.nan
    covariance = bundle.covariance(broken, PRIOR, CONFIG)
    assert np.isnan(covariance.log_focals).all()
    for sigmas in uncertainty.camera_sigmas(broken, covariance, ALL):
        np.testing.assert_array_equal(sigmas, np.full(4, np.inf))


def test_two_cameras_have_no_shape_to_be_wrong_in():
    found = bundle.adjust(problem(), PRIOR, CONFIG)
    _, positions = uncertainty.camera_sigmas(found, bundle.covariance(found, PRIOR, CONFIG), (0, 2))
    assert positions.max() == pytest.approx(0.0, abs=1e-6)
