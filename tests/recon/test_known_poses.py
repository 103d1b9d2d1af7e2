"""Cameras whose poses and lens are told: placed without matches, judged by images, in the given world."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame, Intrinsics, make_given_pose
from splatnode.recon.config import ReconstructionConfig, apply_changes, preset
from splatnode.recon.estimation import Reconstruction, estimate_cameras, estimate_depth, load_prior
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.metric.metres import apply_metric_scale
from splatnode.recon.pipeline import estimate_frame_cameras, run
from splatnode.recon.result.verdict import Code
from splatnode.recon.threads import Clock
from tests.support.synthetic import SMALL, photographs

Array = npt.NDArray[np.float64]

SIGMA_M, SIGMA_DEG = 0.003, 0.1  # of 3 m to the scene
MARGIN = 1.5  # of 95 % bounds, which one error in twenty is beyond
TRUSTING = apply_changes(preset("preview"), {"registration": {"trust_poses": True}})
TRUE = synthetic.scene_cameras(SMALL)


def told(Ts: dict[int, Array], frames: tuple[Frame, ...] | None = None) -> list[Frame]:
    """The photographs with their lens, and with the poses of some."""
    found = []
    for frame in frames or photographs():
        K = TRUE[frame.frame_id][1]
        lens = Intrinsics(frame.width, frame.height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "given")
        T = Ts.get(frame.frame_id)
        pose = None if T is None else make_given_pose(T, SIGMA_M, SIGMA_DEG)
        found.append(replace(frame, intrinsics=lens, given_pose=pose))
    return found


def noisy(seed: int = 0) -> dict[int, Array]:
    generator, found = np.random.default_rng(seed), {}
    for index, (true, _) in enumerate(TRUE):
        T = true.copy()
        turn = np.radians(SIGMA_DEG) * generator.normal(size=3)
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        T[:3, 3] += SIGMA_M * generator.normal(size=3)
        found[index] = T
    return found


@lru_cache(maxsize=1)
def matched() -> ViewGraph:
    alone = apply_changes(TRUSTING, {"registration": {"trust_poses": False}, "no_fallbacks": True})
    return estimate_frame_cameras(told({}), load_prior(alone), alone, Clock())[0].graph


def estimated(
    Ts: dict[int, Array], config: ReconstructionConfig = TRUSTING, graph: ViewGraph | None = None
) -> Reconstruction:
    graph = graph or matched()
    frames = {frame.name: frame for frame in told(Ts)}
    keyframes = tuple(
        replace(keyframe, frame=replace(keyframe.frame, given_pose=frames[keyframe.name].given_pose))
        for keyframe in graph.keyframes
    )
    return estimate_cameras(replace(graph, keyframes=keyframes), (), config)


def assert_bounds_hold(estimate: Reconstruction, but: int | None = None, as_given: bool = True) -> None:
    """Errors in the given world are within the bounds, and these within the sigmas of the poses that were given."""
    assert estimate.prior_world is not None and estimate.registration is not None
    given = estimate.prior_world
    for camera in estimate.registration.cameras:
        if camera.index == but:
            continue
        keyframe = estimate.graph.keyframes[camera.index]
        true, bounds = TRUE[keyframe.frame.frame_id][0], estimate.bounds[keyframe.name]
        centre = given.scale * given.rotation @ camera.T_world_camera[:3, 3] + given.translation
        turn = (given.rotation @ camera.T_world_camera[:3, :3]).T @ true[:3, :3]
        assert np.linalg.norm(centre - true[:3, 3]) < MARGIN * given.scale * bounds.centre
        assert np.degrees(Rotation.from_matrix(turn).magnitude()) < MARGIN * bounds.rotation_deg
        if as_given:
            assert given.scale * bounds.centre < 2.8 * SIGMA_M and bounds.rotation_deg < 2.8 * SIGMA_DEG


@pytest.mark.parametrize("seed", [0, 1])
def test_all_are_placed_within_their_bounds_in_the_given_world_and_none_is_named(seed: int) -> None:
    estimate = estimated(noisy(seed))
    assert estimate.verdict.code is Code.OK, estimate.verdict.message
    assert estimate.prior_world is not None and not estimate.prior_world.deviations
    assert len(estimate.publishable_camera_names) == len(TRUE)
    assert_bounds_hold(estimate)


@pytest.mark.parametrize(("turn_deg", "shift_m"), [(3.0, 0.0), (0.0, 0.1)])
def test_a_false_pose_is_named_with_its_residual_and_its_image_placed_by_the_others(
    turn_deg: float, shift_m: float
) -> None:
    Ts = noisy(2)
    Ts[3][:3, :3] = Ts[3][:3, :3] @ Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    Ts[3][:3, 3] += [0.0, 0.0, shift_m]
    estimate = estimated(Ts)
    assert estimate.prior_world is not None
    names = [estimate.graph.keyframes[each.index].frame.frame_id for each in estimate.prior_world.deviations]
    assert names == [3]
    (deviation,) = estimate.prior_world.deviations
    assert deviation.degrees == pytest.approx(turn_deg, abs=0.5)
    assert deviation.metres == pytest.approx(shift_m, abs=0.02)
    false = photographs()[3].name
    assert f"that of {false} is" in estimate.verdict.message and false in estimate.verdict.frames
    assert estimate.verdict.publishable
    assert_bounds_hold(estimate, but=deviation.index)


@pytest.mark.parametrize(("turned", "named"), [(None, []), (0, [0, 1]), (2, [2, 3])])
def test_of_a_pair_beside_the_others_both_are_named_as_nothing_tells_which_is_false(
    turned: int | None, named: list[int]
) -> None:
    Ts, graph = noisy(2), matched()
    if turned is not None:
        Ts[turned][:3, :3] = Ts[turned][:3, :3] @ Rotation.from_euler("x", 3.0, degrees=True).as_matrix()
    pairs = {pair: graph.pairs[pair] for pair in ((0, 1), (2, 3), (4, 5))}
    estimate = estimated(Ts, graph=replace(graph, pairs=pairs))
    assert estimate.prior_world is not None
    found = [estimate.graph.keyframes[each.index].frame.frame_id for each in estimate.prior_world.deviations]
    assert sorted(found) == named
    held = {estimate.graph.keyframes[index].frame.frame_id for index in estimate.prior_world.held}
    assert held == set(range(6)) - set(named)


def test_images_without_matches_are_where_their_poses_say() -> None:
    names = [frame.name for frame in photographs()]
    graph = matched().remove_keyframes(names[2:]).forget_pairs(names)
    assert len(graph.keyframes) == 2 and not graph.pairs
    estimate = estimated(noisy(3), graph=graph)
    assert estimate.publishable and len(estimate.publishable_camera_names) == 2
    assert_bounds_hold(estimate)


def test_a_wall_without_texture_is_answered_with_the_bounds_of_the_poses() -> None:
    grey = tuple(replace(frame, image=np.full_like(frame.image, 128)) for frame in photographs()[:2])
    alone = estimate_cameras(_blank(grey), (), apply_changes(TRUSTING, {"registration": {"trust_poses": False}}))
    assert alone.verdict.code is Code.LOW_TEXTURE
    estimate = estimate_cameras(_blank(grey), (), TRUSTING)
    assert estimate.publishable
    for bounds in estimate.bounds.values():
        assert estimate.prior_world is not None
        assert estimate.prior_world.scale * bounds.centre == pytest.approx(2.795 * SIGMA_M, rel=0.05)
        assert bounds.rotation_deg == pytest.approx(2.795 * SIGMA_DEG, rel=0.05)
    assert len(estimate_depth(estimate, load_prior(TRUSTING)).pointmaps) == 2


def _blank(frames: tuple[Frame, ...]) -> ViewGraph:
    graph = matched()
    Ts = noisy(4)
    keyframes = []
    for keyframe, frame in zip(graph.keyframes[:2], told(Ts, frames), strict=True):
        none = np.zeros(0, np.int64)
        features = replace(
            keyframe.features,
            points=np.zeros((0, 2)),
            descriptors=np.zeros((0, 128), np.uint8),
            point_of=none,
            tilt=np.zeros(0),
        )
        image = np.full_like(keyframe.image, 128)
        keyframes.append(replace(keyframe, frame=frame, image=image, features=features))
    return ViewGraph(graph.config, tuple(keyframes))


def test_poses_of_a_part_place_the_others() -> None:
    Ts = noisy(5)
    estimate = estimated({index: Ts[index] for index in (0, 2, 5)})
    assert estimate.prior_world is not None and len(estimate.publishable_camera_names) == len(TRUE)
    assert len(estimate.prior_world.held) == 3
    assert estimate.registration is not None
    for camera in estimate.registration.cameras:
        true = TRUE[estimate.graph.keyframes[camera.index].frame.frame_id][0]
        centre = estimate.prior_world.scale * estimate.prior_world.rotation @ camera.T_world_camera[:3, 3]
        assert np.linalg.norm(centre + estimate.prior_world.translation - true[:3, 3]) < 0.02


def drifted(seed: int, share: float, degrees: float) -> dict[int, Array]:
    """Odometry from the first true pose on: each step is off, and all of them by a scale."""
    generator, told = np.random.default_rng(seed), TRUE[0][0].copy()
    scale, found = 1.0 + share * generator.normal(), {0: told}
    for index in range(1, len(TRUE)):
        step = np.linalg.inv(TRUE[index - 1][0]) @ TRUE[index][0]
        length = np.linalg.norm(step[:3, 3])
        step[:3, 3] = scale * step[:3, 3] + share * length * generator.normal(size=3)
        turn = np.radians(degrees) * np.sqrt(length) * generator.normal(size=3)
        step[:3, :3] = step[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        found[index] = told = told @ step
    return found


@pytest.mark.parametrize(("seed", "matches"), [(0, True), (1, True), (0, False), (1, False)])
def test_odometry_that_drifts_holds_cameras_within_bounds_that_grow_with_the_way(seed: int, matches: bool) -> None:
    drifts = {"poses_drift": 0.02, "poses_drift_deg": 0.3}
    config = apply_changes(TRUSTING, {"registration": drifts})
    graph = matched() if matches else replace(matched(), pairs={})
    estimate = estimated(drifted(seed, 0.02, 0.3), config, graph)
    assert estimate.publishable and estimate.prior_world is not None, estimate.verdict.message
    assert len(estimate.publishable_camera_names) == len(TRUE) and not estimate.prior_world.deviations
    assert_bounds_hold(estimate, as_given=False)
    assert estimate.prior_world.scale_sigma > 0.015 and estimate.registration is not None
    by_id = {estimate.graph.keyframes[camera.index].frame.frame_id: camera for camera in estimate.registration.cameras}
    names = {index: estimate.graph.names[camera.index] for index, camera in by_id.items()}
    assert estimate.bounds[names[5]].centre > 2.0 * estimate.bounds[names[0]].centre


def test_an_offset_of_all_poses_is_reported_as_one_and_taken_out() -> None:
    X = np.eye(4)
    X[:3, :3] = Rotation.from_euler("x", 4.0, degrees=True).as_matrix()
    estimate = estimated({index: T @ X for index, T in noisy(6).items()})
    assert estimate.prior_world is not None and estimate.prior_world.offset is not None
    assert (
        abs(estimate.prior_world.offset.degrees - 4.0) < 3.0 * np.degrees(estimate.prior_world.offset.turn_sigma) < 3.0
    )
    assert_bounds_hold(estimate, as_given=False)
    assert "hand-eye" in estimate.verdict.advice and not estimate.prior_world.deviations


def test_poses_that_are_only_checked_hold_nothing() -> None:
    estimate = estimated(noisy(0), apply_changes(TRUSTING, {"registration": {"trust_poses": False}}))
    assert estimate.prior_world is None and estimate.evidence is not None


def test_the_scene_is_in_the_given_world_and_in_metres() -> None:
    snapshot = apply_metric_scale(run(told(noisy(7)), TRUSTING), TRUSTING.metric)
    assert snapshot.scale.metric and "hold the cameras" in str(snapshot.scale.sentence)
    assert len(snapshot.cameras) == len(TRUE) and len(snapshot.gaussians)
    for camera in snapshot.cameras:
        true = TRUE[camera.frame_id][0]
        assert np.linalg.norm(camera.T_world_camera[:3, 3] - true[:3, 3]) < 3 * SIGMA_M
