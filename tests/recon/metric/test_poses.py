"""Poses from odometry give metres and axes; one that is wrong is named and left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame, make_given_pose
from splatnode.recon.metric.measurement import Baseline, MetricConfig, MetricView, make_metric_views
from splatnode.recon.metric.metres import Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.metric.odometry import PoseAlignment, PoseSigmas, align_to_poses
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from tests.recon.result.test_preview import snapshot as ball_snapshot
from tests.support.odometry import drifting

PLACE = synthetic.Config(views=8)
UNIT = 1.7  # metres a unit of the scene
TRUE = [T for T, _ in synthetic.scene_cameras(PLACE)]
NAMES = [synthetic.frame_name(index) for index in range(PLACE.views)]
SIGMAS = PoseSigmas(0.01, 2.0, 0.02)


def scene() -> Snapshot:
    """The true cameras in a world whose unit is UNIT metres, and whose axes are others."""
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    cameras = []
    for index, (T, K) in enumerate(synthetic.scene_cameras(PLACE)):
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = turn @ T[:3, :3], turn @ (T[:3, 3] - TRUE[0][:3, 3]) / UNIT
        cameras.append(CameraEstimate(NAMES[index], index, moved, K, PLACE.width, PLACE.height))
    return replace(ball_snapshot(1), cameras=tuple(cameras))


def views() -> dict[str, MetricView]:
    return dict(make_metric_views(scene()))


def given(seed: int) -> dict[str, np.ndarray]:
    """Odometry with 2 % drift and 2 degrees of noise."""
    return dict(zip(NAMES, drifting(TRUE, np.random.default_rng(seed)), strict=True))


def test_true_poses_give_the_unit_and_the_axes():
    found = align_to_poses(views(), dict(zip(NAMES, TRUE, strict=True)), SIGMAS)
    assert isinstance(found, PoseAlignment) and found.notes == () and found.unit.source == "poses of 8 photographs"
    assert found.unit.metres_per_unit == pytest.approx(UNIT) and 0.005 < found.unit.sigma < 0.03
    metric = apply_metric_scale(scene(), MetricConfig(), Evidence(poses=dict(zip(NAMES, TRUE, strict=True))))
    for camera, T in zip(metric.cameras, TRUE, strict=True):
        np.testing.assert_allclose(camera.T_world_camera, T, atol=1e-6)
    assert metric.scale.metric and (metric.scale.source or "").startswith("poses of 8 photographs, known to")


def test_a_pose_counts_by_its_own_sigma():
    wrong = dict(zip(NAMES, (T.copy() for T in TRUE), strict=True))
    wrong[NAMES[3]][:3, 3] += [0.15, 0.0, 0.0]
    tracker = replace(SIGMAS, drift=0.0)  # with the drift of odometry, so much is to be expected on this way
    sure = align_to_poses(views(), wrong, tracker)
    unsure = align_to_poses(views(), wrong, tracker, {NAMES[3]: (0.3, 10.0)})
    drifting_at_most = align_to_poses(views(), wrong, SIGMAS)
    assert (
        isinstance(sure, PoseAlignment)
        and isinstance(unsure, PoseAlignment)
        and isinstance(drifting_at_most, PoseAlignment)
    )
    assert [told.split(" was ")[0] for told in sure.notes] == [f"the pose of {NAMES[3]}"]
    assert unsure.notes == () and unsure.unit.metres_per_unit == pytest.approx(UNIT, rel=0.003)
    assert drifting_at_most.notes == () and drifting_at_most.unit.sigma > 1.5 * sure.unit.sigma
    alike = align_to_poses(views(), wrong, tracker, dict.fromkeys(NAMES, (0.01, 2.0)))
    assert isinstance(alike, PoseAlignment) and alike.unit == sure.unit


def test_poses_that_came_with_photographs_count_and_those_that_are_given_replace_them():
    tracked = {name: make_given_pose(T, 0.02, 1.0) for name, T in zip(NAMES, TRUE, strict=True)}
    metric = apply_metric_scale(scene(), MetricConfig(), Evidence(tracked=tracked))
    np.testing.assert_allclose(metric.cameras[5].T_world_camera, TRUE[5], atol=1e-6)
    twice = {}
    for name, T in zip(NAMES, TRUE, strict=True):
        twice[name] = T.copy()
        twice[name][:3, 3] *= 2.0
    other = apply_metric_scale(scene(), MetricConfig(), Evidence(tracked=tracked, poses=twice))
    np.testing.assert_allclose(other.cameras[5].T_world_camera, twice[NAMES[5]], atol=1e-6)
    frames = [Frame(0, NAMES[0], 0, np.zeros((8, 8, 3), np.uint8), None, given_pose=tracked[NAMES[0]])]
    assert gather_evidence(frames, MetricConfig()).tracked == {NAMES[0]: tracked[NAMES[0]]}


def test_poses_of_a_country_s_map_are_not_the_world_and_the_scene_says_why():
    """So far from its origin coordinates of 32 bits are half a metre apart."""
    here = {name: T.copy() for name, T in zip(NAMES, TRUE, strict=True)}
    for T in here.values():
        T[:3, 3] += [448_262.0, 5_411_932.0, 320.0]
    told = apply_metric_scale(scene(), MetricConfig(), Evidence(poses=here))
    assert not told.scale.metric and "Subtract one position" in (told.scale.source or "")
    np.testing.assert_array_equal(told.gaussians.means, scene().gaussians.means)
    first = here[NAMES[0]][:3, 3].copy()
    for T in here.values():
        T[:3, 3] -= first
    assert apply_metric_scale(scene(), MetricConfig(), Evidence(poses=here)).scale.metric


def test_odometry_that_drifts_by_2_percent_gives_metres_within_2_percent():
    held = 0
    for seed in range(40):
        found = align_to_poses(views(), given(seed), SIGMAS)
        assert isinstance(found, PoseAlignment)
        low, high = found.unit.interval_95
        held += low <= UNIT / found.unit.metres_per_unit <= high
        assert found.unit.metres_per_unit == pytest.approx(UNIT, rel=0.02), seed
    assert held >= 38


@pytest.mark.parametrize("wrong", range(0, 8, 3))
def test_a_pose_that_is_wrong_by_a_metre_is_named_and_the_rest_stands(wrong):
    poses = given(wrong)
    poses[NAMES[wrong]] = poses[NAMES[wrong]].copy()
    poses[NAMES[wrong]][:3, 3] += [0.6, -0.6, 0.53]
    found = align_to_poses(views(), poses, SIGMAS)
    assert isinstance(found, PoseAlignment) and found.unit.metres_per_unit == pytest.approx(UNIT, rel=0.03)
    (told,) = found.notes
    assert told.startswith(f"the pose of {NAMES[wrong]} was left out: it is 1") or "0.9" in told
    metric = apply_metric_scale(scene(), MetricConfig(), Evidence(poses=poses))
    assert metric.scale.metric and NAMES[wrong] in (metric.scale.source or "") and len(metric.cameras) == 8


def test_a_pose_that_looks_elsewhere_is_named():
    poses = given(1)
    poses[NAMES[4]] = poses[NAMES[4]].copy()
    poses[NAMES[4]][:3, :3] = poses[NAMES[4]][:3, :3] @ Rotation.from_rotvec([0.0, 0.7, 0.0]).as_matrix()
    found = align_to_poses(views(), poses, SIGMAS)
    assert isinstance(found, PoseAlignment) and len(found.notes) == 1
    assert NAMES[4] in found.notes[0] and found.notes[0].endswith("degrees off")


def test_what_poses_cannot_tell_is_said():
    one = align_to_poses(views(), {NAMES[0]: TRUE[0]}, SIGMAS)
    assert isinstance(one, str) and "two are needed" in one
    still = align_to_poses(views(), dict.fromkeys(NAMES, TRUE[0]), SIGMAS)
    assert isinstance(still, str) and "not farther apart than they are unsure" in still
    rng = np.random.default_rng(0)
    nonsense = {name: _anywhere(rng) for name in NAMES}
    refused = align_to_poses(views(), nonsense, SIGMAS)
    assert isinstance(refused, str) and "x right, y down and z forward" in refused


def _anywhere(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    return T


def test_poses_and_a_baseline_are_weighed_together_or_contradict_each_other():
    apart = float(np.linalg.norm(TRUE[7][:3, 3] - TRUE[0][:3, 3]))
    evidence = Evidence(poses=given(2))
    both = apply_metric_scale(scene(), MetricConfig(baseline=Baseline(NAMES[0], NAMES[7], apart)), evidence)
    centres = [camera.T_world_camera[:3, 3] for camera in both.cameras]
    assert np.linalg.norm(centres[7] - centres[0]) == pytest.approx(apart, rel=0.015)
    np.testing.assert_allclose(np.mean(centres, 0), np.mean([T[:3, 3] for T in TRUE], 0), atol=0.1)
    torn = apply_metric_scale(scene(), MetricConfig(baseline=Baseline(NAMES[0], NAMES[7], 1.2 * apart)), evidence)
    assert not torn.scale.metric and "contradicts poses of 8 photographs" in (torn.scale.source or "")
