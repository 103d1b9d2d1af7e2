"""The exposure of a novel view: what the training views around it imply, and how unsure that is."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.frame import Clock, Stamp
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.view_exposure import (
    MAX_VIEWS,
    ViewGains,
    collect_view_gains,
    interpolate_gains,
    relative_illumination,
)


def pose(x: float, turn_deg: float = 0.0) -> np.ndarray:
    T, angle = np.eye(4), np.radians(turn_deg)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[0, 3] = x
    return T


def along(count: int, drift: float, sigma: float = 0.005) -> ViewGains:
    """Views in a row whose gains grow evenly by a factor of `drift`, more in red."""
    places = np.linspace(-0.5, 0.5, count)
    logs = np.log(drift) * places[:, None] * (1.2, 1.0, 0.8)
    poses = np.array([pose(x) for x in np.linspace(0.0, 1.0, count)])
    return ViewGains(poses, logs, np.full((count, 3), sigma))


@pytest.mark.parametrize("count", [3, 6, 12])
@pytest.mark.parametrize("drift", [1.1, 1.4, 0.6])
def test_between_views_of_a_drift_its_gains_are_found(count, drift):
    known = along(count, drift)
    for x in (0.1, 0.3, 0.5, 0.8):
        expected = np.log(drift) * (x - 0.5) * np.array([1.2, 1.0, 0.8])
        assert interpolate_gains(known, pose(x)).logs == pytest.approx(expected, abs=0.012 if count > 3 else 0.02)


def test_at_a_view_the_gains_are_its_own():
    known = along(6, 1.4)
    for T, logs in zip(known.Ts_world_camera, known.logs, strict=True):
        found = interpolate_gains(known, T)
        assert found.logs == pytest.approx(logs, abs=0.01) and found.gains == pytest.approx(np.exp(found.logs))


def test_uncertainty_grows_away_from_the_views_and_gains_become_their_mean():
    known = along(6, 1.4)
    near, between, beside, far = (interpolate_gains(known, pose(x)) for x in (0.2, 0.3, 1.4, 60.0))
    assert (near.sigmas < beside.sigmas).all() and (between.sigmas < beside.sigmas).all()
    assert (beside.sigmas < far.sigmas).all() and (far.sigmas > 0.08).all()
    assert np.abs(far.logs).max() < 0.06
    turned = interpolate_gains(known, pose(0.3, 90.0))
    assert (turned.sigmas > between.sigmas).all()


def test_views_without_gains_imply_none_and_noise_stays_small():
    poses = np.array([pose(x) for x in np.linspace(0.0, 1.0, 8)])
    none = ViewGains(poses, np.zeros((8, 3)), np.full((8, 3), 0.01))
    assert not interpolate_gains(none, pose(0.35)).logs.any()
    noise = np.random.default_rng(0).normal(0.0, 0.01, (8, 3))
    noisy = interpolate_gains(ViewGains(poses, noise, np.full((8, 3), 0.01)), pose(0.35))
    assert np.abs(noisy.logs).max() < 0.01


def test_gains_follow_where_a_camera_looks_if_it_stays_in_place():
    turns = np.linspace(0.0, 60.0, 7)
    logs = np.repeat(0.3 * np.sin(np.radians(3.0 * turns))[:, None], 3, 1)
    known = ViewGains(np.array([pose(0.0, turn) for turn in turns]), logs, np.full((7, 3), 0.005))
    found = interpolate_gains(known, pose(0.0, 35.0))
    assert found.logs == pytest.approx(0.3 * np.sin(np.radians(105.0)), abs=0.03)


def camera(name: str, x: float, time_s: float | None) -> CameraEstimate:
    stamp = None if time_s is None else Stamp(round(1e9 * time_s), Clock.UTC)
    return CameraEstimate(name, 0, pose(x), np.eye(3), 64, 48, captured_at=stamp)


def test_time_tells_apart_what_poses_do_not():
    """A camera that goes back and forth on one path while the light fades."""
    places, times = [0.0, 0.5, 1.0, 0.5, 0.0, 0.5, 1.0], np.arange(7.0)
    cameras = [camera(f"{time}", x, time) for x, time in zip(places, times, strict=True)]
    gains = {f"{time}": (float(np.exp(0.1 * time - 0.3)),) * 3 for time in times}
    sigmas = {name: (0.005,) * 3 for name in gains}
    known = collect_view_gains(cameras, gains, sigmas)
    timed = interpolate_gains(known, pose(0.5), 4.5)
    untimed = interpolate_gains(known, pose(0.5))
    assert timed.logs == pytest.approx(0.15, abs=0.03) and (timed.sigmas < untimed.sigmas).all()
    unknown = collect_view_gains([*cameras, camera("8", 0.0, None)], gains, sigmas)
    assert unknown.times_s is None and not unknown.logs[-1].any()


def test_a_few_views_of_many_tell():
    many = along(10 * MAX_VIEWS, 1.4)
    assert interpolate_gains(many, pose(0.25)).logs == pytest.approx(
        np.log(1.4) * -0.25 * np.array([1.2, 1, 0.8]), abs=0.01
    )


def test_one_view_tells_its_own_gains_and_none_tell_nothing():
    one = ViewGains(pose(0.0)[None], np.full((1, 3), 0.2), np.full((1, 3), 0.01))
    assert interpolate_gains(one, pose(0.0)).logs == pytest.approx(0.2, abs=0.01)
    with pytest.raises(ValueError, match="at least one view"):
        interpolate_gains(collect_view_gains([], {}, {}), pose(0.0))


def test_vignetting_leaves_the_middle_and_dims_the_corners():
    light = relative_illumination(0.5, 64, 48)
    assert light[24, 32] == pytest.approx(1.0, abs=1e-3) and light[0, 0] == pytest.approx(np.exp(-0.5), abs=0.02)
