"""Cameras that depth images place, in rooms where photographs show nothing to match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.diorama import Solid, look_at
from splatnode.capture.frame import Frame
from splatnode.recon.config import preset
from splatnode.recon.estimation import estimate_cameras_by_depth, prepare_all
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.metric.depth_alignment import (
    PlacedCamera,
    align_clouds,
    choose_alignment,
    find_exchanged_depth,
    make_depth_cloud,
    place_beside,
    place_by_depth,
)
from splatnode.recon.metric.metres import Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.pipeline import estimate_frames, run
from splatnode.recon.result.verdict import Code
from splatnode.recon.threads import Clock
from tests.support.depth_camera import DepthCamera, measure_along_rays
from tests.support.plain_rooms import Room, make_room, make_room_with_plain_view, photograph

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


def make_walls(length: float, width: float) -> list[Solid]:
    """The shell of a corridor, 2.5 m high."""
    shell = make_room(7, 1, boxes=0).solids[:6]
    half, height = np.array([length, width]) / 2, 2.5
    centres = [(*half, -0.05), (*half, height + 0.05)]
    centres += [(x, half[1], height / 2) for x in (-0.05, length + 0.05)]
    centres += [(half[0], y, height / 2) for y in (-0.05, width + 0.05)]
    sizes = [(*half, 0.05)] * 2 + [(0.05, half[1], height / 2)] * 2 + [(half[0], 0.05, height / 2)] * 2
    return [
        replace(wall, centre=np.array(centre), axes=np.diag(size))
        for wall, centre, size in zip(shell, centres, sizes, strict=True)
    ]


def make_box(centre: Sequence[float], half: Sequence[float]) -> Solid:
    """A box along the walls."""
    return replace(make_room(7, 1, boxes=0).solids[4], centre=np.array(centre), axes=np.diag(half))


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


def test_a_first_camera_that_is_left_open_is_left_out_alone():
    boxes = [make_box((0.8, 0.8, 0.55), (0.4, 0.3, 0.55)), make_box((0.55, 2.3, 0.35), (0.25, 0.3, 0.35))]
    way = [((2.4, 4.6), (0.0, 4.7, 0.6)), ((2.5, 3.9), (0.0, 3.3, 0.7)), ((2.6, 3.4), (0.2, 2.3, 0.8))]
    way += [((2.6, 2.9), (0.5, 1.6, 0.9)), ((2.7, 2.7), (0.6, 1.1, 0.7))]
    cameras = tuple((look_at(np.array([*at, 1.3]), np.array(to)), room().cameras[0][1]) for at, to in way)
    placed = place_by_depth(photograph(Room((*make_walls(6.0, 9.0), *boxes), cameras), 0, DepthCamera()))
    assert [camera.name for camera in placed][-3:] == ["room_002.png", "room_003.png", "room_004.png"]
    check_placed(placed, [cameras[int(camera.name[5:8])][0] for camera in placed])


def test_clouds_of_two_rooms_are_not_aligned():
    one = make_depth_cloud(frames()[0])
    other = make_depth_cloud(photograph(make_room(4, 1), 4, DepthCamera(seed=4))[0])
    assert one is not None and other is not None
    assert choose_alignment(align_clouds(one, other), one, other) is None


def test_a_corridor_that_repeats_itself_places_no_camera():
    K = room().cameras[0][1]
    walk = [(look_at(np.array([5.0 + x, 0.9, 1.2]), np.array([8.0 + x, 0.1, 1.0])), K) for x in (0.0, 0.45)]
    pillars = [make_box((x, 0.075, 1.25), (0.1, 0.075, 1.25)) for x in np.arange(0.4, 39.0, 0.5)]
    corridor = Room((*make_walls(40.0, 1.8), *pillars), tuple(walk))
    one, other = (make_depth_cloud(frame) for frame in photograph(corridor, 7, DepthCamera(seed=7)))
    assert one is not None and other is not None
    alignments = align_clouds(other, one)
    possible = [each.T_target_cloud[:3, 3] for each in alignments if each.is_possible]
    assert any(np.linalg.norm(a - b) > 0.4 for a in possible for b in possible)
    assert choose_alignment(alignments, other, one) is None


@pytest.mark.parametrize(
    ("measured_at", "exchanged"), [((0, 1, 2), {}), ((0, 0, 1), {1: 0, 2: 1}), ((0, 2, 1), {1: 2, 2: 1})]
)
def test_a_depth_image_of_another_moment_is_found(measured_at, exchanged):
    clouds = [
        make_depth_cloud(replace(frame, depth=frames()[k].depth))
        for frame, k in zip(frames(), measured_at, strict=True)
    ]
    assert find_exchanged_depth([cloud for cloud in clouds if cloud is not None]) == exchanged


def test_cameras_are_not_placed_by_depth_images_of_another_moment(caplog):
    stuck = [replace(frame, depth=frames()[0].depth) for frame in frames()]
    assert place_by_depth(stuck) == ()
    assert "the depth image of room_001.png fits the photograph room_000.png much better" in caplog.text


def test_no_camera_is_placed_by_distances_along_the_rays(caplog):
    along = []
    for frame in frames():
        assert frame.depth is not None and frame.intrinsics is not None
        height, width = frame.depth.values.shape
        along.append(replace(frame, depth=measure_along_rays(frame.depth, frame.intrinsics.resized(width, height).K)))
    assert not place_by_depth(along) and "distances along the rays" in caplog.text


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
    shaded = replace(other, log_light=other.log_light + np.linspace(0.0, 1.0, len(other.log_light)))
    assert choose_alignment(align_clouds(one, shaded), one, shaded) is None


def test_the_advice_names_the_lens_that_depth_images_want():
    config = preset("preview")
    config = msgspec.structs.replace(config, fallbacks=msgspec.structs.replace(config.fallbacks, budget=0.0))
    untold = photograph(room(), SEED, DepthCamera(seed=SEED), tell_lens=False)
    advised, _ = estimate_frames(untold, config, Clock())
    assert advised.verdict.code is Code.LOW_TEXTURE and "--intrinsics" in advised.verdict.advice
    alone, _ = estimate_frames([replace(frame, depth=None) for frame in untold], config, Clock())
    assert "--intrinsics" not in alone.verdict.advice


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


@pytest.mark.parametrize(("count", "placed"), [(0, True), (35, True), (80, False)])
def test_many_matches_may_contradict_the_depth_that_places_cameras_and_few_may_not(count, placed):
    """Of points .8 m before the camera, nearer than the walls: edges of plain walls give such matches, but few."""
    config, rng = preset("preview"), np.random.default_rng(5)
    keyframes, _ = prepare_all(frames(), config)
    (T, K), (T_other, K_other) = room().cameras[:2]
    width, height = keyframes[0].frame.width, keyframes[0].frame.height
    pixels = rng.uniform((0.3 * width, 0.3 * height), (0.7 * width, 0.7 * height), (count, 2))
    rays = np.column_stack([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones(count)])
    world = 0.8 * rays @ T[:3, :3].T + T[:3, 3]
    seen = (world - T_other[:3, 3]) @ T_other[:3, :3] @ K_other.T
    others = seen[:, :2] / seen[:, 2:]
    shown = [
        replace(keyframe, features=replace(keyframe.features, points=np.vstack([keyframe.features.points, points])))
        for keyframe, points in zip(keyframes, (pixels, others, np.empty((0, 2))), strict=True)
    ]
    numbers = np.column_stack([len(keyframe.features.points) + np.arange(count) for keyframe in keyframes[:2]])
    centred = (pixels - K[:2, 2], others - K_other[:2, 2])
    pair = TwoView(numbers, *centred, count, -100.0, 0, 0, K[0, 0] / max(width, height))
    graph = ViewGraph(config.matching, tuple(shown), {(0, 1): pair} if count else {})
    found = estimate_cameras_by_depth(graph, config)
    assert (found is not None and found.verdict.publishable) == placed
    if found is not None and found.registration is not None:
        assert len(found.registration.points) == 0


@cache
def make_plain_view(seed: int, plain: int) -> tuple[Room, tuple[Frame, ...], dict[str, np.ndarray]]:
    """A room of which one photograph shows plain walls, its frames, and what is known of the cameras of the others."""
    place, rng = make_room_with_plain_view(seed, 6, plain), np.random.default_rng(seed)
    shown, known = photograph(place, seed, DepthCamera(seed=seed)), {}
    for index, frame in enumerate(shown):
        T = place.cameras[index][0].copy()
        T[:3, :3] = Rotation.from_rotvec(np.radians(rng.normal(0.0, 0.05, 3))).as_matrix() @ T[:3, :3]
        T[:3, 3] += rng.normal(0.0, 0.003, 3)
        if index != plain:
            known[frame.name] = T
    return place, tuple(shown), known


def test_a_camera_before_plain_walls_is_placed_beside_those_that_are_known():
    place, shown, known = make_plain_view(3, 3)
    (placed,) = place_beside(shown, known)
    T = place.cameras[3][0]
    assert placed.name == shown[3].name
    assert np.linalg.norm(placed.T_world_camera[:3, 3] - T[:3, 3]) < 3.0 * WITHIN * placed.sigma_m < 0.1
    turn = Rotation.from_matrix(placed.T_world_camera[:3, :3].T @ T[:3, :3]).magnitude()
    assert np.degrees(turn) < WITHIN * placed.sigma_deg < 1.0


def test_a_camera_of_which_neighbours_tell_different_places_is_not_placed():
    """Each of both alone would have it .7 to .9 m off, where it overlaps with more of a plain wall."""
    _, shown, known = make_plain_view(0, 3)
    assert place_beside(shown, known) == ()


def test_beside_known_cameras_that_depth_contradicts_nothing_is_placed():
    _, shown, known = make_plain_view(3, 3)
    moved = {name: T.copy() for name, T in known.items()}
    moved[shown[1].name][:3, 3] += [0.4, 0.4, 0.0]
    assert place_beside(shown, moved) == ()
    assert place_beside(shown, {shown[0].name: known[shown[0].name]}) == ()


def test_an_answered_set_is_extended_by_a_photograph_of_plain_walls():
    place, shown, _ = make_plain_view(2, 5)
    extended, _ = estimate_frames(shown, preset("preview"), Clock())
    assert extended.publishable_camera_names == {frame.name for frame in shown}
    assert "All 6 photographs were placed, 1 of them by what their depth images measured" in extended.verdict.message
    world, registration = extended.prior_world, extended.registration
    assert world is not None and registration is not None
    centres = {
        extended.graph.names[camera.index]: world.scale * camera.T_world_camera[:3, 3]
        for camera in registration.cameras
    }
    apart = np.linalg.norm(centres[shown[5].name] - centres[shown[0].name])
    assert abs(apart - np.linalg.norm(place.cameras[5][0][:3, 3] - place.cameras[0][0][:3, 3])) < 0.05
