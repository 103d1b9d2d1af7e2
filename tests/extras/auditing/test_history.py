"""Moves of cameras are found, dated, measured, and grouped by what moved as one; noise moves nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.extras.audit import (
    MIN_COMMON,
    CameraSighting,
    Move,
    Period,
    extend_history,
    find_moves,
    measure_motion,
)
from splatnode.recon.locating import LocalizationBounds, Located
from splatnode.recon.locating.localize import Localization
from splatnode.recon.locating.pose_refinement import PINHOLE, CameraModel, Correspondences, Lens

LENS = Lens(500.0, PINHOLE, np.zeros(2), 0.0, 0.0, 0.0)
SIZE = (640, 480)
NOISE_PX = 0.3
LEFT, RIGHT = np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.1, 0.0])


def rigid(turn_deg=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix(), shift
    return T


def placed(T_world_camera: np.ndarray, seed: int, count: int = 300) -> Localization:
    """A photograph of `count` of the same points, each seen with noise of its own."""
    points = np.random.default_rng(0).uniform([-0.8, -0.6, 0.7], [0.8, 0.6, 1.6], (300, 3))[:count]
    inverse = np.linalg.inv(T_world_camera)
    camera = CameraModel(inverse[:3, :3], inverse[:3, 3], LENS)
    noise = np.random.default_rng(seed).normal(scale=NOISE_PX, size=(count, 2))
    number, zero = np.arange(count), np.zeros((count, 3, 3))
    seen = Correspondences(camera.project(points)[0] + noise, number, points, zero, number, number, points)
    covariance = 1e-6 * np.eye(6)
    located = Located(T_world_camera, np.eye(3), covariance, LocalizationBounds(0.1, 0.01, 1.0, 1.0), count, False)
    return Localization(located, camera, seen, SIZE, spread=1.0)


def history(*Ts: np.ndarray, first_seed: int = 1) -> dict[int, CameraSighting]:
    return {i: CameraSighting(f"{i}.png", placed(T, first_seed + i)) for i, T in enumerate(Ts)}


def periods(sightings: dict[int, CameraSighting]) -> list[Period]:
    found: list[Period] = []
    for number, sighting in sightings.items():
        found = extend_history(found, number, sighting)
    return found


def test_noise_moves_nothing():
    T = rigid((3.0, -5.0, 2.0), LEFT)
    for seed in range(200):
        found = measure_motion(placed(T, 2 * seed), placed(T, 2 * seed + 1))
        assert found.common == 300 and not found.is_significant


@pytest.mark.parametrize(
    "turn, shift", [((0.3, 0, 0), (0, 0, 0)), ((0, 0, 0), (0, 0, 0.005)), ((20, 5, 0), (0.1, 0, 0))]
)
def test_a_move_is_measured(turn, shift):
    T, move = rigid((3.0, -5.0, 2.0), LEFT), rigid(turn, shift)
    found = measure_motion(placed(T, 1), placed(T @ move, 2))
    assert found.is_significant
    assert np.degrees(Rotation.from_matrix(move[:3, :3]).magnitude()) == pytest.approx(found.degrees, abs=0.06)
    assert np.linalg.norm(found.T_before_after[:3, 3] - shift) < 0.001
    assert found.degrees_sigma < 0.1 and found.distance_sigma < 0.003


def test_a_camera_that_zoomed_has_not_moved():
    T = rigid((3.0, -5.0, 2.0), LEFT)
    before, after = placed(T, 1), placed(T, 2)
    zoomed = replace(after.seen, pixels=1.3 * after.seen.pixels)
    located = replace(after.located, K=np.diag([1.3, 1.3, 1.0]))
    found = measure_motion(before, replace(after, seen=zoomed, located=located))
    assert found.common == 0 and not found.is_significant  # by their common points it moved forward by a third


def test_a_move_is_known_the_less_the_closer_the_cameras_of_the_scene_stand_together():
    T = rigid((3.0, -5.0, 2.0), LEFT)
    move = rigid((0.0, 1.0, 0.0), (0.03, 0.0, 0.0))
    sigmas = [
        measure_motion(replace(placed(T, 1), spread=spread), placed(T @ move, 2)).degrees_sigma
        for spread in (1.0, 0.1, 0.0)
    ]
    assert sigmas[0] < sigmas[1] < sigmas[2] < 0.1  # where they stand at one place, all that is wrong counts


def test_what_is_the_least_to_be_noticed_is_noticed_and_half_of_it_is_not():
    T = rigid((3.0, -5.0, 2.0), LEFT)
    least = measure_motion(placed(T, 1), placed(T, 2)).least_shift
    shifted = [
        measure_motion(placed(T, 3), placed(T @ rigid(shift=(0.0, 0.0, factor * least)), 4)) for factor in (1.5, 0.3)
    ]
    assert [each.is_significant for each in shifted] == [True, False]


def test_with_few_common_points_each_photograph_stands_for_itself():
    T = rigid((3.0, -5.0, 2.0), LEFT)
    found = measure_motion(placed(T, 1), placed(T @ rigid((0.0, 5.0, 0.0)), 2, count=MIN_COMMON - 1))
    assert found.common == 0 and found.is_significant and found.degrees == pytest.approx(5.0, abs=1e-6)


def test_periods_end_where_the_camera_moves_and_slow_drift_adds_up():
    T, aside = rigid(shift=LEFT), rigid((0.0, 1.0, 0.0))
    found = periods(history(T, T, T @ aside, T @ aside, T))
    assert [period.recordings for period in found] == [(0, 1), (2, 3), (4,)]
    assert found[0].came_by is None and found[1].came_by is not None
    assert found[1].came_by.degrees == pytest.approx(1.0, abs=0.05)
    drifting = periods(history(*(T @ rigid((0.0, 0.05 * i, 0.0)) for i in range(12))))
    assert 2 <= len(drifting) < 12


def test_cameras_that_move_alike_in_the_world_moved_as_one():
    body = rigid((0.0, 3.0, 1.0), (0.05, 0.0, 0.02))
    left, right = rigid((0.0, 5.0, 0.0), LEFT), rigid((0.0, -5.0, 0.0), RIGHT)
    together = {
        "left": periods(history(left, left, body @ left)),
        "right": periods(history(right, right, body @ right, first_seed=50)),
    }
    assert find_moves(together) == [Move(1, 2, ("left", "right"))]
    apart = together | {"right": periods(history(right, right, right @ body, first_seed=50))}
    assert find_moves(apart) == [Move(1, 2, ("left",)), Move(1, 2, ("right",))]
    one_only = together | {"right": periods(history(right, right, right, first_seed=50))}
    assert find_moves(one_only) == [Move(1, 2, ("left",))]
    at_another_time = together | {"right": periods(history(right, body @ right, body @ right, first_seed=50))}
    assert find_moves(at_another_time) == [Move(0, 1, ("right",)), Move(1, 2, ("left",))]
