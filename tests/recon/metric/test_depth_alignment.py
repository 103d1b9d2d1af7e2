"""Cameras that depth images place, in rooms where photographs show nothing to match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from splatnode.capture.diorama import look_at
from splatnode.capture.frame import Frame
from splatnode.recon.config import preset
from splatnode.recon.metric.depth_alignment import (
    PlacedCamera,
    align_clouds,
    choose_alignment,
    make_depth_cloud,
    place_by_depth,
)
from splatnode.recon.metric.metres import Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.pipeline import estimate_frames, run
from splatnode.recon.result.verdict import Code
from splatnode.recon.threads import Clock
from tests.support.depth_camera import DepthCamera
from tests.support.plain_rooms import Room, make_room, photograph

SEED, VIEWS = 1, 3
WITHIN = 2.45  # standard deviations: 95 % of three independent errors are nearer


@cache
def room() -> Room:
    return make_room(SEED, VIEWS)


@cache
def frames() -> tuple[Frame, ...]:
    return tuple(photograph(room(), SEED, DepthCamera(seed=SEED)))


def make_wall_frames(shifts: Sequence[float]) -> list[Frame]:
    """Frames of a camera that goes along a plain wall: the floor and the wall leave the way along it open."""
    K = room().cameras[0][1]
    walk = [(look_at(np.array([2.0 + x, 1.6, 1.2]), np.array([2.0 + x, -5.0, 0.2])), K) for x in shifts]
    empty = replace(make_room(7, 1, boxes=0), cameras=tuple(walk))
    long = replace(empty.solids[0], axes=np.diag([40.0, 40.0, 0.05]), centre=np.array([0.0, 0.0, -0.05]))
    wall = replace(empty.solids[4], axes=np.diag([40.0, 0.05, 40.0]), centre=np.array([0.0, -0.05, 0.0]))
    return photograph(Room((long, wall), empty.cameras), 7, DepthCamera(seed=7))


def check_placed(placed: Sequence[PlacedCamera], cameras: Sequence[np.ndarray]) -> None:
    """Checks each camera against the true one, T_world_camera, in the frame of the first."""
    for camera, T in zip(placed, cameras, strict=True):
        expected = np.linalg.inv(cameras[0]) @ T
        off = np.linalg.norm(camera.T_world_camera[:3, 3] - expected[:3, 3])
        turn = np.degrees(Rotation.from_matrix(camera.T_world_camera[:3, :3].T @ expected[:3, :3]).magnitude())
        assert off < WITHIN * camera.sigma_m
        assert turn < WITHIN * camera.sigma_deg


def test_depth_places_cameras_of_a_plain_room_within_their_sigmas():
    placed = place_by_depth(frames())
    assert [camera.name for camera in placed] == [frame.name for frame in frames()]
    check_placed(placed, [T for T, _ in room().cameras])
    assert max(camera.sigma_m for camera in placed) < 0.02


def test_the_order_of_the_frames_does_not_matter():
    forward, backward = (place_by_depth(order) for order in (frames(), frames()[::-1]))
    for one, other in zip(forward, backward, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)


def test_no_camera_is_placed_whose_way_a_plain_wall_leaves_open():
    assert place_by_depth(make_wall_frames((0.0, 0.2))) == ()


def test_clouds_of_two_rooms_are_not_aligned():
    one = make_depth_cloud(frames()[0])
    other = make_depth_cloud(photograph(make_room(4, 1), 4, DepthCamera(seed=4))[0])
    assert one is not None and other is not None
    assert choose_alignment(align_clouds(one, other), one, other) is None


def test_a_frame_needs_depth_and_a_lens_that_was_told():
    frame = frames()[0]
    assert frame.intrinsics is not None
    assert make_depth_cloud(replace(frame, depth=None)) is None
    assert make_depth_cloud(replace(frame, intrinsics=None)) is None
    assert make_depth_cloud(replace(frame, intrinsics=replace(frame.intrinsics, source="exif"))) is None


def test_walls_whose_brightness_differs_are_not_the_same():
    one, other = make_depth_cloud(frames()[0]), make_depth_cloud(frames()[1])
    assert one is not None and other is not None
    alignments = align_clouds(one, other)
    assert choose_alignment(alignments, one, other) is not None
    shade = np.linspace(0.0, 1.0, len(other.log_light))
    assert choose_alignment(align_clouds(one, replace(other, log_light=other.log_light + shade)), one, replace(
        other, log_light=other.log_light + shade)) is None  # fmt: skip


def test_photographs_alone_are_refused_and_depth_gives_metres():
    alone, _ = estimate_frames([replace(frame, depth=None) for frame in frames()], preset("preview"), Clock())
    assert alone.verdict.code is Code.LOW_TEXTURE
    config = preset("preview")
    snapshot = run(frames(), config)
    assert snapshot.verdict.publishable
    assert "by what their depth images measured" in snapshot.verdict.message
    metric = apply_metric_scale(snapshot, config.metric, Evidence().merge(gather_evidence(frames(), config.metric)))
    assert metric.scale.metric and metric.scale.interval_95 is not None
    centres = [camera.T_world_camera[:3, 3] for camera in metric.cameras]
    true = [T[:3, 3] for T, _ in room().cameras]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        apart, expected = (float(np.linalg.norm(each[i] - each[j])) for each in (centres, true))
        assert abs(apart - expected) < 0.02
    assert all(camera.given is None for camera in metric.cameras)  # nobody gave a pose
    assert len(metric.gaussians) > 0
