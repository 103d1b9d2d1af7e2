"""How wrong a camera is, and whether that is within what was claimed of it, worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.stability.trial import (
    CameraError,
    FiniteBounds,
    has_only_right_cameras,
    measure_camera_errors,
)
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import Bounds, make_ball
from tests.support.stability_places import HEIGHT, WIDTH, K, on_arc

BOUNDS = FiniteBounds(rotation_deg=1.0, centre_percent=2.0, focal_percent=4.0)
GOOD = CameraError("a", rotation_deg=0.9, centre_pct=1.9, spread_pct=4.0, focal_pct=3.0, bounds=BOUNDS)
TRUTH = {
    f"{degrees}": TrueCamera(on_arc(degrees, distance=3.0), K, WIDTH, HEIGHT) for degrees in (0, 20, 40, 90, 180, 270)
}


def estimated(*degrees: int, distance: float = 1.0) -> list[CameraEstimate]:
    """The true cameras, in a world whose unit is the distance to the scene."""
    return [CameraEstimate(f"{d}", 0, on_arc(d, distance), K, WIDTH, HEIGHT) for d in degrees]


def test_a_centre_is_wrong_in_percent_of_the_distance_and_of_the_spread():
    cameras = estimated(0, 90, 180, 270, distance=0.5)  # half as far away as the scene, and their spread is as much
    for number, shift in enumerate((0.01, -0.01, 0.01, -0.01)):  # up and down in turns: no similarity makes up for it
        cameras[number].T_world_camera[1, 3] += shift
    errors = measure_camera_errors(cameras, TRUTH)
    assert [error.centre_pct for error in errors] == pytest.approx([1.0] * 4, rel=1e-3)
    assert [error.spread_pct for error in errors] == pytest.approx([2.0] * 4, rel=1e-3)
    assert max(error.rotation_deg for error in errors) < 1e-5 and has_only_right_cameras(errors)


def test_two_centres_are_compared_in_the_direction_in_which_the_cameras_look():
    cameras = estimated(0, 20)
    assert max(error.spread_pct for error in measure_camera_errors(cameras, TRUTH)) < 1e-4
    cameras[1].T_world_camera[1, 3] += 0.1
    assert not has_only_right_cameras(measure_camera_errors(cameras, TRUTH)), (
        "a similarity of the centres alone would hide it"
    )
    assert measure_camera_errors(cameras[:1], TRUTH) == ()


def test_focal_lengths_are_compared_at_one_size():
    cameras = [replace(camera, K=0.55 * K, width=WIDTH // 2, height=HEIGHT // 2) for camera in estimated(0, 20, 40)]
    assert [error.focal_pct for error in measure_camera_errors(cameras, TRUTH)] == pytest.approx([10.0] * 3)


@pytest.mark.parametrize(
    ("changes", "rough", "wrong"),
    [
        ({}, False, False),
        ({"rotation_deg": 2.4}, False, False),
        ({"rotation_deg": 2.6}, False, True),
        ({"centre_pct": 5.1}, False, True),
        ({"focal_pct": 10.1}, False, True),
        ({"rotation_deg": 5.1, "bounds": replace(BOUNDS, rotation_deg=4.0)}, False, True),
        ({"rotation_deg": 5.1, "bounds": replace(BOUNDS, rotation_deg=4.0)}, True, False),
        ({"centre_pct": 11.0, "bounds": replace(BOUNDS, centre_percent=6.0)}, False, True),
        ({"centre_pct": 11.0, "bounds": replace(BOUNDS, centre_percent=6.0)}, True, False),
        ({"rotation_deg": 4.9, "spread_pct": 9.9, "focal_pct": 50.0, "bounds": None}, False, False),
        ({"spread_pct": 10.1, "bounds": None}, False, True),
        ({"centre_pct": None, "spread_pct": None}, True, True),
    ],
)
def test_wrong_is_beyond_the_claim(changes, rough, wrong):
    assert replace(GOOD, **changes).is_wrong(rough) is wrong


def test_bounds_that_are_not_finite_claim_nothing():
    infinite = Bounds(float("inf"), float("nan"), float("nan"), float("inf"), make_ball(float("nan")))
    cameras = [replace(camera, bounds=infinite) for camera in estimated(0, 20, 40)]
    assert not any(error.is_wrong(rough=False) for error in measure_camera_errors(cameras, TRUTH))
    assert all(
        np.isfinite(bound)
        for error in measure_camera_errors(cameras, TRUTH)
        for _, bound in error.pair_with_bounds().values()
    )
