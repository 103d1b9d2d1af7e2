"""The floor and the direction of up, of points and cameras that are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.diorama import look_at
from splatnode.recon.occupancy import find_floor, level, make_level_frame, upright
from splatnode.recon.result.verdict import FrameName, ReferenceFrame

UP = np.array([0.0, 0.0, 1.0])


def room(rng: np.random.Generator, floor: int, table: int, wall: int) -> np.ndarray:
    """(M, 3) points of a floor z = 0, a table at .7 and a wall x = 3, with 3 mm of noise."""
    parts = [
        np.column_stack([rng.uniform(0, 3, floor), rng.uniform(-2, 2, floor), np.zeros(floor)]),
        np.column_stack([rng.uniform(1, 2, table), rng.uniform(-0.5, 0.5, table), np.full(table, 0.7)]),
        np.column_stack([np.full(wall, 3.0), rng.uniform(-2, 2, wall), rng.uniform(0, 2.5, wall)]),
    ]
    return np.concatenate(parts) + rng.normal(0, 0.003, (floor + table + wall, 3))


def cameras(*heights: float) -> list[np.ndarray]:
    return [look_at(np.array([-1.0, y, h]), np.array([2.0, 0, 0.5])) for y, h in zip((-1, 0, 1), heights, strict=True)]


def test_the_floor_is_found_below_a_table_that_more_pixels_show():
    points = room(np.random.default_rng(0), 3000, 6000, 9000)
    tilted = np.array([0.4, 0.1, 1.0]) / np.linalg.norm([0.4, 0.1, 1.0])  # as from cameras that look down
    floor = find_floor(points, np.stack(cameras(1.5, 1.6, 1.4))[:, :3, 3], tilted, 3.0)
    assert floor is not None and floor.normal @ UP > np.cos(np.radians(0.2))
    assert abs(floor.height(np.array([1.0, 0, 0.5]), UP) - 0.5) < 0.005 and floor.share == pytest.approx(
        1 / 6, abs=0.03
    )


def test_a_strip_of_floor_tells_up_less_surely_than_a_whole_one():
    """And by as much as strips are really off: depths beside each other are wrong alike, as of a bent floor."""
    centres, sigmas = np.stack(cameras(1.5, 1.6, 1.4))[:, :3, 3], []
    for wide in (2.0, 0.15):
        off = []
        for seed in range(12):
            rng = np.random.default_rng(seed)
            points = room(rng, 3000, 0, 9000)
            points[:3000, 1] *= wide / 2.0
            bend = rng.normal(0.0, 0.01, 2)  # at its ends
            points[:3000, 2] += bend[0] * points[:3000, 0] / 3.0 + bend[1] * (points[:3000, 1] / wide) ** 3
            floor = find_floor(points, centres, UP, 3.0)
            assert floor is not None
            off.append(np.degrees(np.arccos(min(1.0, floor.normal @ UP))))
            sigmas.append(floor.tilt_deg)
        assert np.mean(np.array(off) < 1.96 * np.hypot(1.0, sigmas[-12:])) > 0.9
    assert np.median(sigmas[:12]) < 1.0 and np.median(sigmas[12:]) > 3.0 * np.median(sigmas[:12])


@pytest.mark.parametrize(("floor", "table"), [(0, 0), (0, 6000), (200, 200)])
def test_without_a_floor_none_is_found(floor, table):
    """A table that hides what is below it is no floor: the wall goes on below it."""
    points = room(np.random.default_rng(0), floor, table, 9000)
    assert find_floor(points, np.stack(cameras(1.5, 1.6, 1.4))[:, :3, 3], UP, 3.0) is None


def test_cameras_that_look_down_still_tell_where_up_is():
    Ts = np.stack(cameras(1.5, 1.6, 1.4))
    assert level(Ts)[0] @ UP > np.cos(np.radians(0.1)) and "not rolled" in level(Ts)[1]
    alike = np.stack([Ts[1]] * 3)
    assert "mean up" in level(alike)[1] and level(alike)[0] @ UP > 0.9


def test_without_a_floor_heights_count_from_the_first_camera():
    points = room(np.random.default_rng(0), 0, 0, 9000)
    frame = upright(cameras(1.5, 1.6, 1.4), points, None, 3.0)
    assert not frame.on_floor and "height of the first camera" in frame.height
    assert np.allclose(frame.T_world_map[:3, 3], [-1, -1, 1.5])
    assert np.allclose(frame.T_world_map[:3, :3] @ frame.T_world_map[:3, :3].T, np.eye(3))
    assert np.linalg.det(frame.T_world_map[:3, :3]) == pytest.approx(1)


def test_a_camera_that_looks_straight_down_has_a_frame():
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[2, 3] = 1.5
    frame = upright([T], room(np.random.default_rng(0), 3000, 0, 0), UP, 1.5)
    assert frame.on_floor and np.allclose(frame.T_world_map[:3, 2], UP) and abs(frame.T_world_map[2, 3]) < 0.01
    assert np.allclose(frame.T_world_map[:3, 0], [0, 1, 0])  # its upper side


def test_where_the_floor_leans_in_what_tells_up_heights_count_from_it():
    """Below the first camera alone z would be 0 on it: a map called obstacles farther on free."""
    points, Ts = room(np.random.default_rng(0), 3000, 6000, 9000), cameras(1.5, 1.6, 1.4)
    leaning = np.array([np.sin(np.radians(4.5)), 0.0, np.cos(np.radians(4.5))])
    told, given = upright(Ts, points, leaning, 3.0, "gravity"), upright(Ts, points, leaning, 3.0)
    assert told.T_world_map[:3, 2] @ UP > np.cos(np.radians(0.3)) and told.on_floor
    assert told.source.startswith("the floor, which leans by 4.") and told.source.endswith(" degrees by gravity")
    assert np.allclose(given.T_world_map[:3, 2], leaning) and given.source == "given"
    level_one = upright(Ts, points, np.array([0.01, 0.0, 1.0]), 3.0, "gravity")
    assert level_one.source == "gravity"


@pytest.mark.parametrize("name", [FrameName.ODOMETRY, FrameName.BASE])
def test_a_frame_in_which_the_floor_leans_is_not_that_of_the_map(name):
    points, Ts = room(np.random.default_rng(0), 3000, 6000, 9000), cameras(1.5, 1.6, 1.4)
    turn = Rotation.from_euler("y", 4.5, degrees=True).as_matrix()
    T = np.eye(4)
    T[:3, :3] = turn
    own = make_level_frame(Ts, points, 3.0, ReferenceFrame(name))
    assert own is not None and own.on_floor and own.is_of_result
    assert make_level_frame([T @ each for each in Ts], points @ turn.T, 3.0, ReferenceFrame(name)) is None
