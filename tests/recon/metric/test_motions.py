"""Motions from wheels and an IMU give metres; one that is wrong is named and left out, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from splatnode.capture.diorama import Config as Odometry
from splatnode.capture.diorama import odometry
from splatnode.capture.frame import Gravity, Motion
from splatnode.recon.metric.measurement import Measurement, MetricConfig, MetricView, make_metric_views
from splatnode.recon.metric.metres import Evidence, apply_metric_scale
from splatnode.recon.metric.odometry import estimate_scale_from_motions, estimate_up
from tests.recon.metric.test_poses import NAMES, TRUE, UNIT, scene

NOISY = Odometry(drift=0.02, noise_deg=2.0)
SHARED = 0.01


def views() -> dict[str, MetricView]:
    return dict(make_metric_views(scene()))


def measured(seed: int, noise: Odometry = NOISY) -> tuple[dict[str, Motion], dict[str, Gravity]]:
    motions, gravities = zip(*odometry(NAMES, TRUE, noise, seed), strict=True)
    return dict(zip(NAMES, motions, strict=True)), dict(zip(NAMES, gravities, strict=True))


def unit_of(said: list) -> Measurement:
    assert isinstance(said[0], Measurement), said
    return said[0]


def test_noisy_motions_give_metres_within_two_percent_and_the_interval_holds():
    held = left_out = 0
    for seed in range(100):
        said = estimate_scale_from_motions(views(), measured(seed)[0], SHARED)
        unit = unit_of(said)
        assert unit.metres_per_unit == pytest.approx(UNIT, rel=0.02)
        left_out += len(said) - 1
        low, high = unit.interval_95
        held += low <= UNIT / unit.metres_per_unit <= high
        assert high < 1.04
    assert held >= 95 and left_out <= 4  # of 700: what lies beyond 3 standard deviations by chance


def test_a_motion_that_is_wrong_is_named_and_the_rest_stands():
    right, _ = measured(3)
    motion, wrong = Motion(NAMES[0]), {NAMES[0]: Motion(NAMES[0])}
    for before, name in pairwise(NAMES):
        step = np.linalg.inv(right[before].matrix) @ right[name].matrix
        step[0, 3] += name == NAMES[4]  # the wheels slipped by a metre
        motion = wrong[name] = motion.append_step(step, 0.01, 2.0)
    said = estimate_scale_from_motions(views(), wrong, SHARED)
    assert unit_of(said).metres_per_unit == pytest.approx(UNIT, rel=0.02)
    assert len(said) == 2 and str(said[1]).startswith(f"the motion from {NAMES[3]} to {NAMES[4]} was left out: it is 1")
    metric = apply_metric_scale(scene(), MetricConfig(), Evidence(motions=wrong))
    assert metric.scale.metric and "the motion from" in (metric.scale.source or "")
    factor = metric.cameras[5].T_world_camera[0, 3] / scene().cameras[5].T_world_camera[0, 3]
    for camera, before in zip(metric.cameras, scene().cameras, strict=True):
        np.testing.assert_allclose(camera.T_world_camera[:3, :3], before.T_world_camera[:3, :3])
        np.testing.assert_allclose(camera.T_world_camera[:3, 3], factor * before.T_world_camera[:3, 3])


def test_keyframes_that_are_missing_and_chains_that_begin_anew_cost_little():
    motions, _ = measured(5)
    few = {name: motions[name] for name in (NAMES[0], NAMES[3], NAMES[7])}
    loose = unit_of(estimate_scale_from_motions(views(), few, 0.0))
    assert loose.source == "motions between 2 pairs of photographs"
    assert loose.metres_per_unit == pytest.approx(UNIT, rel=0.05) and loose.sigma > 0.005
    second = {name: replace(motion, chain="after a gap") for name, motion in motions.items() if name >= NAMES[4]}
    parted = unit_of(estimate_scale_from_motions(views(), {**motions, **second}, 0.0))
    assert parted.source == "motions between 6 pairs of photographs"
    assert parted.metres_per_unit == pytest.approx(UNIT, rel=0.02)


def test_sigmas_grow_with_what_lies_between_and_with_what_all_share():
    motions, _ = measured(6)
    ends = unit_of(estimate_scale_from_motions(views(), {name: motions[name] for name in (NAMES[0], NAMES[7])}, 0.0))
    whole = unit_of(estimate_scale_from_motions(views(), motions, 0.0))
    shared = unit_of(estimate_scale_from_motions(views(), motions, 0.02))
    assert ends.sigma > 0 and whole.sigma < 0.01 and shared.sigma == pytest.approx(np.hypot(whole.sigma, 0.02))


def test_what_says_nothing_says_why():
    motions, _ = measured(0)
    assert (
        estimate_scale_from_motions(views(), {}, SHARED)
        == []
        == estimate_scale_from_motions(views(), {NAMES[0]: Motion("a")}, SHARED)
    )
    (alone,) = estimate_scale_from_motions(views(), {NAMES[1]: motions[NAMES[1]]}, SHARED)
    assert "none of them is between two cameras" in str(alone)
    shaken = {name: replace(motions[name], sigma_m=10.0 * index) for index, name in enumerate(NAMES)}
    (unsure,) = estimate_scale_from_motions(views(), shaken, SHARED)
    assert "not longer than they are unsure" in str(unsure)
    rng, lost, motion = np.random.default_rng(0), {NAMES[0]: Motion("lost")}, Motion("lost")
    for name in NAMES[1:]:
        step = np.eye(4)
        step[:3, 3] = rng.normal(size=3)
        motion = lost[name] = motion.append_step(step, 0.005, 1.0)
    (unfit,) = estimate_scale_from_motions(views(), lost, SHARED)
    assert "fit the cameras of the scene: are they of the camera" in str(unfit)


def test_gravity_gives_up_and_one_that_is_wrong_is_named():
    true_up = scene().cameras[0].T_world_camera[:3, :3] @ TRUE[0][:3, :3].T @ [0.0, 0.0, 1.0]
    off = []
    for seed in range(40):
        up = estimate_up(views(), measured(seed)[1])
        assert up is not None
        off.append(np.degrees(np.arccos(min(1.0, np.dot(up.direction, true_up)))) / up.sigma_deg)
    assert np.mean(np.array(off) < 2.45) >= 0.95 and up.source == "gravity in 8 photographs"
    gravities = measured(1)[1]
    gravities[NAMES[2]] = Gravity((1.0, 0.0, 0.0), 2.0)
    found = estimate_up(views(), gravities)
    assert found is not None and f"that of {NAMES[2]} was left out" in found.source
    moved = apply_metric_scale(scene(), MetricConfig(), Evidence(gravities=gravities))
    assert moved.up == found and not moved.scale.metric
    assert estimate_up(views(), {}) is None
    scattered = {name: Gravity((np.cos(i), np.sin(i), i - 3.5), 1.0) for i, name in enumerate(NAMES)}
    assert estimate_up(views(), scattered) is None
