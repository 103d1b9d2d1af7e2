from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture import lenses
from splatnode.extras.calibration.estimate import MODELS, project_points

RNG = np.random.default_rng(0)
NUMBERS = {
    "pinhole": [],
    "opencv2": [-0.3, 0.1],
    "opencv4": [-0.3, 0.1, 0.002, -0.003],
    "opencv5": [-0.3, 0.1, 0.002, -0.003, 0.02],
    "opencv8": [1.2, 0.15, 0.002, -0.003, 0.01, 1.5, 0.42, 0.02],
    "fisheye": [0.01, -0.005, 0.002, -0.0004],
}


def numbers_of(name: str) -> np.ndarray:
    return np.array([500.0, 510.0, 322.0, 238.0, *NUMBERS[name]])


def points_of(name: str) -> np.ndarray:
    """Also on the axis and, through a fisheye, behind the camera."""
    ahead = RNG.uniform([-1, -1, 1], [1, 1, 2], (30, 3))
    behind = RNG.uniform([1, 1, -0.8], [2, 2, -0.1], (10, 3))
    return np.concatenate([ahead, [[0.0, 0.0, 1.5]], *([behind] if name == "fisheye" else [])])


@pytest.mark.parametrize("name", MODELS)
def test_pixels_are_those_of_the_lens_that_is_written(name: str):
    points = points_of(name)
    lens = MODELS[name].lens(numbers_of(name), 640, 480)
    found = project_points(points, numbers_of(name), MODELS[name].kind).pixels
    assert np.abs(found - lenses.project(points, lens)).max() < 1e-6


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_are_those_of_small_steps(name: str):
    points, numbers, kind, step = points_of(name)[:-1], numbers_of(name), MODELS[name].kind, 1e-6
    found = project_points(points, numbers, kind)
    for axis in range(3):
        way = step * np.eye(3)[axis]
        change = project_points(points + way, numbers, kind).pixels - project_points(points - way, numbers, kind).pixels
        assert np.allclose(found.by_point[:, :, axis], change / (2 * step), rtol=1e-5, atol=1e-3)
    for number in range(len(numbers)):
        way = step * np.eye(len(numbers))[number]
        change = project_points(points, numbers + way, kind).pixels - project_points(points, numbers - way, kind).pixels
        assert np.allclose(found.by_lens[:, :, number], change / (2 * step), rtol=1e-5, atol=1e-3)


def test_a_radial_lens_sees_nothing_behind_it():
    assert np.isnan(project_points(np.array([[0.1, 0.2, -1.0]]), numbers_of("opencv5"), "opencv").pixels).all()
