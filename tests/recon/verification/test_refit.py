"""A made-up bundle of exact observations, adjusted from other starts, without some points, with lenses set free."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.recon.registration import bundle_adjustment
from splatnode.recon.verification import refit
from tests.support.verdicts import graph, registration

FOCAL = 900.0


def made_up(noise_px: float = 0.2, depth: float = 1.0, radial: float = 0.0, focal: float = FOCAL) -> refit.BundleFit:
    """Four cameras on an arc around 200 points, `depth` deep at distance 4; `focal` is what the fit is told."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (200, 3)) * (1.2, 0.9, depth)
    rotations, translations = [], []
    for azimuth in np.radians([-18.0, -5.0, 7.0, 20.0]):
        rotation = cv2.Rodrigues(np.array([0.1 * np.sin(9 * azimuth), azimuth, 0.0]))[0]
        rotations.append(rotation)
        translations.append(np.array([0.0, 0.0, 4.0]))
    observed = [(camera, point) for point in range(len(points)) for camera in range(4)]
    exact = bundle_adjustment.Problem(
        rotations=np.stack(rotations),
        translations=np.stack(translations),
        lens_of_camera=np.zeros(4, np.int64),
        log_focals=np.log([FOCAL]),
        radials=np.array([[radial, 0.0]]),
        shifts=np.zeros((1, 2)),
        points=points,
        camera_of=np.array([camera for camera, _ in observed]),
        point_of=np.array([point for _, point in observed]),
        pixels=np.zeros((len(observed), 2)),
    )
    pixels = bundle_adjustment.project(exact)[0]
    seen, pinhole = pixels + rng.normal(0, noise_px, pixels.shape), np.zeros((1, 2))
    problem = replace(exact, pixels=seen, log_focals=np.log([focal]), radials=pinhole)
    prior = bundle_adjustment.LensPrior(problem.log_focals, np.array([refit.FREE_SIGMA]), np.zeros((1, 2)), np.zeros(1))
    unknown = np.full(1, np.nan), np.full(1, np.inf), np.zeros(1, bool)
    return refit.BundleFit(
        problem, prior, bundle_adjustment.BundleAdjustmentConfig(robust_px=1.0), 1.0, *unknown, np.ones(1)
    )


def given(fit: refit.BundleFit) -> refit.BundleFit:
    """The fit with a focal length that is held as it is."""
    return replace(fit, prior=replace(fit.prior, sigmas=np.zeros(1)), given_focals=np.exp(fit.problem.log_focals))


def test_nothing_moves_between_a_fit_and_itself():
    fit = refit.adjust(made_up())
    between = refit.compute_shift(fit, fit)
    assert between.rotation_deg < 1e-5 and between.centre_rel < 1e-9 and between.focal_rel == 0.0


def test_a_moved_camera_is_measured_whatever_the_world_is():
    fit = made_up()
    turn = cv2.Rodrigues(np.radians([0.0, 2.0, 0.0]))[0]
    rotations = fit.problem.rotations.copy()
    rotations[2] = turn @ rotations[2]
    translations = fit.problem.translations.copy()
    translations[2] = turn @ translations[2]  # turned on the spot
    world = cv2.Rodrigues(np.array([0.3, -1.0, 0.5]))[0]
    moved = replace(
        fit.problem,
        rotations=rotations @ world.T,
        translations=2.0 * translations,  # twice as large a world
    )
    between = refit.compute_shift(fit, replace(fit, problem=moved))
    assert between.rotation_deg == pytest.approx(2.0, abs=1e-4)
    assert between.centre_rel < 0.02  # the common rotation is shared out, and turns the centres a little


def test_a_fit_that_came_to_nothing_is_lost():
    fit = made_up()
    broken = replace(fit, problem=replace(fit.problem, translations=np.full((4, 3), np.nan)))
    assert refit.compute_shift(fit, broken) == refit.LOST


def test_without_points_only_their_observations_go():
    fit = made_up()
    left_out = np.zeros(200, bool)
    left_out[::3] = True
    smaller = refit.remove_points(fit, left_out).problem
    assert len(smaller.points) == 133 and len(smaller.pixels) == 4 * 133
    assert np.allclose(smaller.points, fit.problem.points[~left_out])
    assert np.abs(bundle_adjustment.reprojection_errors(smaller)).max() < 1.5


def test_the_spread_grows_with_what_the_model_leaves_out():
    """Four times the noise, or distortion that is not modelled: both must show."""
    quiet, noisy, bent = (refit.estimate_spread(fit) for fit in (made_up(0.1), made_up(0.4), made_up(0.1, radial=0.1)))
    assert max(quiet.rotation_deg) < 0.1 and max(quiet.centre) < 0.01
    assert max(noisy.centre) > 2 * max(quiet.centre)
    assert max(bent.rotation_deg) > 3 * max(quiet.rotation_deg) and max(bent.centre) > 2 * max(quiet.centre)
    assert max(bent.focal_rel) > 3 * max(quiet.focal_rel)


def test_perspective_tells_a_scene_from_its_mirror_image():
    assert refit.compute_reversal_cost_ratio(made_up(depth=1.0)) > 5.0


def test_the_mirrored_scene_of_a_camera_far_away_cannot_be_told():
    """From 400 times its size away, a scene and its mirror image look the same."""
    near = made_up(noise_px=0.5)
    far = replace(
        near.problem,
        translations=near.problem.translations * (1.0, 1.0, 100.0),
        log_focals=near.problem.log_focals + np.log(100.0),
    )
    pixels = bundle_adjustment.project(far)[0] + np.random.default_rng(1).normal(0, 0.5, near.problem.pixels.shape)
    assert refit.compute_reversal_cost_ratio(given(replace(near, problem=replace(far, pixels=pixels)))) < 1.2


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
def test_a_given_focal_length_is_found_right_or_wrong(factor):
    (freed,) = refit.free_lenses(given(made_up(focal=factor * FOCAL)))
    assert freed.trusted and freed.given == pytest.approx(factor * FOCAL)
    assert freed.found == pytest.approx(FOCAL, rel=0.02)
    assert (freed.cost_ratio < 0.5) == (factor != 1.0)


def test_a_nominal_focal_length_is_doubted_too():
    (freed,) = refit.free_lenses(replace(made_up(focal=0.8 * FOCAL), given_focals=np.array([0.8 * FOCAL])))
    assert not freed.trusted and freed.found == pytest.approx(FOCAL, rel=0.02) and freed.cost_ratio < 0.5


def test_no_lens_is_freed_that_did_not_come_with_the_frames():
    assert refit.free_lenses(made_up()) == ()


def test_distortion_that_the_observations_ask_for():
    bent = refit.measure_distortion(made_up(radial=-0.2))
    # A corner is 0.6 * 1024 pixels from the middle.
    assert bent.corner_shift == pytest.approx(0.2 * (0.6 * 1024 / FOCAL) ** 2, rel=0.1)
    assert bent.cost_ratio < 0.6
    straight = refit.measure_distortion(made_up())
    assert straight.corner_shift < 0.01 and straight.cost_ratio > 0.97


def zoom(fit: refit.BundleFit, camera: int, factor: float) -> refit.BundleFit:
    """The same fit, of which one image was zoomed and nothing tells it."""
    pixels = fit.problem.pixels.copy()
    pixels[fit.problem.camera_of == camera] *= factor
    return replace(fit, problem=replace(fit.problem, pixels=pixels))


def test_a_zoom_that_a_flat_scene_hides_moves_its_camera_no_farther_than_is_doubted():
    """All at one distance: a zoom of 6 % looks like a step of 6 % of the distance, 4."""
    flat = given(made_up(depth=0.02))
    truth = flat.Ts_world_camera[:, :3, 3]
    zoomed = zoom(flat, 1, 1.06)
    doubted = refit.doubt_common_lenses(zoomed)
    found = refit.umeyama(refit.adjust(zoomed).Ts_world_camera[:, :3, 3], truth)
    error = np.linalg.norm(found(refit.adjust(zoomed).Ts_world_camera[:, :3, 3]) - truth, axis=1)
    assert error.max() > 0.04  # the lens that is held is believed, and the camera is off
    assert (error < 2.5 * 0.6 * doubted.centre).all()


def test_where_depth_tells_the_lenses_little_is_doubted():
    deep, flat = (refit.doubt_common_lenses(given(made_up(depth=depth))) for depth in (3.0, 0.02))
    assert deep.centre.max() < 0.2 * flat.centre.max() and deep.focals_rel.max() < 0.4 * flat.focals_rel.max()


def test_a_keystone_correction_of_all_images_is_doubted_by_as_much_as_it_turns_them():
    """All images shifted by a fifth of their side; the lens is taken to be behind their middle."""
    fit = made_up()
    truth = fit.Ts_world_camera
    shifted = replace(fit, problem=replace(fit.problem, pixels=fit.problem.pixels + (0.0, 0.2 * 1024)))
    whole = refit.adjust(shifted)
    error = refit.compute_camera_shifts(replace(whole, problem=fit.problem), whole).rotation_deg
    doubted, square = refit.doubt_common_lenses(shifted), refit.doubt_common_lenses(fit)
    assert error.max() > 2.0 and (truth == fit.Ts_world_camera).all()
    assert (error < 2.5 * 0.6 * doubted.rotation_deg).all()
    assert square.rotation_deg.max() < 0.65 * doubted.rotation_deg.max()


def test_lenses_of_their_own_explain_little_of_right_ones_and_much_of_a_stretched_image():
    fit = made_up()
    stretched = fit.problem.pixels * np.where(fit.problem.camera_of == 1, 1.05, 1.0)[:, None] ** (0.0, 1.0)
    changed = replace(fit, problem=replace(fit.problem, pixels=stretched))
    assert refit.compute_own_lens_cost(fit) > 0.9
    assert refit.compute_own_lens_cost(changed) < 0.4


def test_a_lens_that_no_other_camera_shares_keeps_its_prior():
    """Four calibrated lenses, one a camera: nothing is doubted but what noise leaves open."""
    fit = made_up(depth=0.02)
    four = {"log_focals": np.full(4, np.log(FOCAL)), "radials": np.zeros((4, 2)), "shifts": np.zeros((4, 2))}
    problem = replace(fit.problem, lens_of_camera=np.arange(4), **four)
    prior = bundle_adjustment.LensPrior(problem.log_focals, np.zeros(4), np.zeros((4, 2)), np.zeros(4))
    alone = replace(
        fit, problem=problem, prior=prior, given_focals=np.full(4, FOCAL), nominal_sigmas=np.full(4, np.inf),
        own=np.zeros(4, bool), units=np.ones(4),
    )  # fmt: skip
    assert refit.doubt_common_lenses(alone).focals_rel.max() < 1e-6
    assert refit.doubt_common_lenses(alone).centre.max() < 0.2 * refit.doubt_common_lenses(given(fit)).centre.max()


def test_the_prior_of_an_aspect_is_as_wide_as_the_aspect_is_far_from_square():
    placed = replace(
        registration((0, 1)),
        points=np.array([[0.1, 0.0, 1.0]]),
        observed_by=np.array([0, 1]),
        observed_point=np.zeros(2, np.int64),
        observed_pixels=np.array([[38.0, 24.0], [26.0, 24.0]]),
    )
    widths = {}
    for aspect in (1.0, 1.05, 1.5):
        cameras = tuple(replace(camera, aspect=aspect) for camera in placed.cameras)
        fit = refit.build_fit(graph(2, {}).keyframes, replace(placed, cameras=cameras), 10)
        widths[aspect] = fit.prior.own_sigmas[0, 5]
    assert widths == pytest.approx({1.0: 0.0, 1.05: refit.FREE_ASPECT, 1.5: np.log(1.5)})
