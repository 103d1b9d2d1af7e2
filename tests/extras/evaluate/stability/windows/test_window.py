"""Which windows are drawn, and the angle between neighbouring views, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.extras.evaluate.dataset import EvaluationScene, TrueCamera
from splatnode.extras.evaluate.stability.perturbations import TrialScene
from splatnode.extras.evaluate.stability.windows import compute_angle_deg, draw_windows, select_moving_scenes
from tests.support.stability_places import HEIGHT, WIDTH, K, on_arc, three_places


def test_windows_are_consecutive_photographs_at_a_stride(tmp_path):
    place = three_places(tmp_path).walked[0]  # twelve photographs
    windows = draw_windows(place, 2, seed=0)
    kinds = [(window.count, window.stride) for window in windows]
    assert sorted(set(kinds)) == [(3, 1), (3, 2), (3, 3), (3, 4), (6, 1), (6, 2), (12, 1)]
    assert kinds.count((3, 1)) == kinds.count((6, 2)) == 2 and kinds.count((12, 1)) == 1
    assert len({(window.count, window.stride, window.start) for window in windows}) == len(windows)
    for window in windows:
        positions = [window.start + window.stride * i for i in range(window.count)]
        assert [int(name[:2]) for name in window.names] == positions
        assert window.angle_deg == pytest.approx(6.0 * window.stride)
    assert windows == draw_windows(place, 2, seed=0) and windows != draw_windows(place, 2, seed=1)


def test_the_angle_is_that_to_the_nearest_other_view_as_the_middle_of_the_scene_sees_it():
    assert compute_angle_deg(np.stack([on_arc(d) for d in (0, 10, 40)])) == pytest.approx(30.0)
    assert compute_angle_deg(np.stack([on_arc(d) for d in (0, 10, 40, 55)])) == pytest.approx(15.0)


def test_without_a_middle_the_angle_is_that_between_the_viewing_directions():
    parallel = [np.eye(4) for _ in range(3)]
    for number, T_world_camera in enumerate(parallel):
        T_world_camera[0, 3] = number
    assert compute_angle_deg(np.stack(parallel)) == pytest.approx(0.0, abs=1e-5)
    outward = [on_arc(d, distance=-1.0) for d in (0, 20, 40)]  # the axes meet behind the cameras
    assert compute_angle_deg(np.stack(outward)) == pytest.approx(20.0)


def test_a_camera_that_only_turns_has_no_windows(caplog):
    names = tuple(f"{i}" for i in range(6))
    cameras = {name: TrueCamera(on_arc(5.0 * i, distance=0.0), K, WIDTH, HEIGHT) for i, name in enumerate(names)}
    place = TrialScene(EvaluationScene("tripod", {}, cameras), names)
    assert select_moving_scenes([place]) == [] and draw_windows(place, 2, seed=0) == []
    assert "no windows of tripod: the true cameras do not move" in caplog.text
