"""The camera's derivatives are those of its projection, and the covariance is that of its estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.recon.locating.pose_refinement import (
    CORRELATED,
    NUM_PARAMETERS,
    CameraModel,
    Correspondences,
    Lens,
    optimize_camera,
    pose_covariance,
    undistort_pixels,
)

CAMERA = CameraModel(
    Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix(),
    np.array([0.1, -0.2, 0.5]),
    Lens(500.0, (-0.05, 0.02), np.array([3.0, -2.0]), 0.0, 0.0, 0.0),
)


def points(count: int) -> np.ndarray:
    """World points, at depths 2 to 5 in the camera."""
    draw = np.random.default_rng(0)
    in_camera = np.column_stack([draw.uniform(-1, 1, (count, 2)), draw.uniform(2, 5, count)])
    return (in_camera - CAMERA.translation) @ CAMERA.rotation


def seen(noise_px: float, seed: int, count: int = 200) -> Correspondences:
    world = points(count)
    pixels = CAMERA.project(world)[0] + np.random.default_rng(seed).normal(0, noise_px, (count, 2))
    index = np.arange(count)
    exact = np.zeros((count, 3, 3))
    return Correspondences(pixels, index, world, exact, index, index, world)


@pytest.mark.parametrize("parameter", range(NUM_PARAMETERS))
def test_derivatives_by_the_parameters(parameter):
    world, step = points(7), np.zeros(NUM_PARAMETERS)
    step[parameter] = 1e-6
    by_parameters, _ = CAMERA.derivatives(world)
    numeric = (CAMERA.apply_step(step).project(world)[0] - CAMERA.apply_step(-step).project(world)[0]) / 2e-6
    assert np.allclose(by_parameters[:, :, parameter], numeric, rtol=1e-4, atol=1e-4)


def test_derivatives_by_the_points():
    world = points(7)
    _, by_points = CAMERA.derivatives(world)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        numeric = (CAMERA.project(world + step)[0] - CAMERA.project(world - step)[0]) / 2e-6
        assert np.allclose(by_points[:, :, axis], numeric, rtol=1e-4, atol=1e-4)


def test_pixels_without_distortion_are_those_of_a_pinhole():
    world = points(9)
    straight = replace(CAMERA, lens=replace(CAMERA.lens, radial=(0.0, 0.0), shift=np.zeros(2)))
    assert np.allclose(undistort_pixels(CAMERA.project(world)[0], CAMERA.lens), straight.project(world)[0], atol=0.01)


def test_the_camera_is_found_again_from_nearby():
    step = np.array([0.02, -0.01, 0.015, 0.05, -0.03, 0.04, 0, 0, 0, 0, 0])
    fit = optimize_camera(CAMERA.apply_step(step), CAMERA.lens, seen(0.0, 0), 0.5)
    assert np.allclose(fit.camera.T_world_camera, CAMERA.T_world_camera, atol=1e-6)


def test_the_covariance_is_that_of_the_errors_times_the_observations_that_count_as_one():
    twists, claimed = [], np.zeros((6, 6))
    for seed in range(200):
        fit = optimize_camera(CAMERA, CAMERA.lens, seen(0.5, seed), 0.5)
        between = np.linalg.inv(CAMERA.T_world_camera) @ fit.camera.T_world_camera
        twists.append([*between[:3, 3], *Rotation.from_matrix(between[:3, :3]).as_rotvec()])
        claimed = pose_covariance(fit.camera, fit.covariance) / CORRELATED
    ratio = np.sqrt(np.diag(np.cov(np.array(twists).T)) / np.diag(claimed))
    assert ratio.min() > 0.75 and ratio.max() < 1.35
    correlation = np.corrcoef(np.array(twists).T)[0, 4], (claimed / np.sqrt(np.outer(*2 * [np.diag(claimed)])))[0, 4]
    assert abs(correlation[0] - correlation[1]) < 0.15
