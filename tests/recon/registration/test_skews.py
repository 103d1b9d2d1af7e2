"""Single images that are stretched or sheared: each is found with the aspect and the skew that it has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from splatnode.extras.evaluate.stability.degradations import change_shape
from splatnode.recon.registration import bundle_adjustment
from splatnode.recon.registration.registration import undistort_keyframes
from tests.recon.registration.test_bundle import disturbed, problem
from tests.recon.registration.test_own_lenses import PLACE, check_within_bounds, estimate, own, photographs

Array = npt.NDArray[np.float64]


def lens_of_its_own(problem: bundle_adjustment.Problem, skew: float) -> bundle_adjustment.Problem:
    """The problem with a second lens, of its last camera: the first one's, with a skew."""
    return replace(
        problem,
        lens_of_camera=np.array([0, 0, 0, 1]),
        log_focals=np.repeat(problem.log_focals, 2),
        radials=np.repeat(problem.radials, 2, axis=0),
        shifts=np.repeat(problem.shifts, 2, axis=0),
        skews=np.array([0.0, skew]),
    )


def test_a_skew_is_projected_and_taken_out_again():
    exact = lens_of_its_own(problem(noise_px=0.0), 0.04)
    pixels, depth = bundle_adjustment.project(exact)
    straight, _ = bundle_adjustment.project(replace(exact, skews=np.zeros(2)))
    last = exact.camera_of == 3
    np.testing.assert_allclose(pixels[~last], straight[~last])
    below = straight[last, 1] - exact.shifts[1, 1]
    np.testing.assert_allclose(pixels[last], straight[last] + np.outer(0.04 * below, [1.0, 0.0]), atol=1e-9)
    rays = bundle_adjustment.normalise(exact, exact.camera_of, pixels)
    in_camera = np.einsum("oij,oj->oi", exact.rotations[exact.camera_of], exact.points[exact.point_of])
    in_camera = in_camera + exact.translations[exact.camera_of]
    np.testing.assert_allclose(rays, in_camera[:, :2] / depth[:, None], atol=1e-6)


@pytest.mark.parametrize("skew", [-0.06, 0.03])
def test_a_bundle_finds_the_skew_of_a_lens(skew):
    true = lens_of_its_own(problem(noise_px=0.0), skew)
    true = replace(true, pixels=bundle_adjustment.project(true)[0])
    start = lens_of_its_own(disturbed(problem(noise_px=0.0)), 0.0)
    prior = bundle_adjustment.LensPrior(
        np.log([950.0, 950.0]), np.full(2, 0.3), np.full((2, 2), 0.1), np.full(2, 10.0), skew_sigmas=np.array([0, 0.5])
    )
    config = bundle_adjustment.BundleAdjustmentConfig(noise_px=0.01, max_iterations=200, tolerance=1e-12)
    found = bundle_adjustment.adjust(replace(start, pixels=true.pixels), prior, config)
    assert found.all_skews == pytest.approx([0.0, skew], abs=1e-4)
    assert np.exp(found.log_focals) == pytest.approx(900.0, rel=1e-3)


@pytest.mark.numerical
@pytest.mark.parametrize(
    ("count", "number", "down", "shear"),
    [(3, 1, 1.08, 0.0), (3, 1, 1.0, 0.05), (4, 1, 1.0, -0.04), (4, 3, 0.95, 0.03)],
)
def test_one_image_of_another_shape_is_right_within_its_bounds(count, number, down, shear):
    taken = photographs()[:count]
    photos = [change_shape(photo, down, shear) if index == number else photo for index, photo in enumerate(taken)]
    found = estimate(photos)
    check_within_bounds(photos, found)
    assert photos[number].name in own(found)
    assert found.registration is not None
    camera = next(each for each in found.registration.cameras if each.index == number)
    assert camera.aspect == pytest.approx(down, abs=0.02)
    assert camera.skew == pytest.approx(shear, abs=0.015)


@pytest.mark.numerical
def test_a_sheared_image_is_modelled_without_its_shear():
    taken = photographs()[:4]
    photos = [change_shape(photo, shear=0.05) if index == 1 else photo for index, photo in enumerate(taken)]
    found = estimate(photos)
    assert found.registration is not None
    graph, straight = undistort_keyframes(found.graph, found.registration)
    camera = next(each for each in straight.cameras if each.index == 1)
    lens = graph.keyframes[1].lens
    assert lens is not None and lens.skew == pytest.approx(0.05, abs=0.015) and camera.skew == 0.0
    pinhole = graph.keyframes[1].frame.intrinsics
    assert pinhole is not None and pinhole.skew == 0.0
    # Points that all cameras see are where the straight cameras project them.
    mine = straight.observed_by == 1
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    points = straight.points[straight.observed_point[mine]] @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    pixels = camera.focal * points[:, :2] / points[:, 2:] + camera.principal
    errors = np.linalg.norm(pixels - straight.observed_pixels[mine], axis=1)
    assert np.median(errors) < 0.5 * PLACE.width / 640
