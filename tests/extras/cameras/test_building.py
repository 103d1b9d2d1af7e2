import itertools
from functools import lru_cache

import msgspec
import numpy as np
import pytest

from splatnode.capture.config import CaptureConfig, camera_opener
from splatnode.capture.diorama import look_at
from splatnode.capture.frame import Clock, Frame, Stamp
from splatnode.capture.process.config import parse_config
from splatnode.extras.building import CHAIR_ROOM, CORRIDOR, LOOK_ALIKES, MIRROR_ROOM, ZONES, interior, zones_at
from splatnode.extras.cameras import building

TINY = building.Config(width=96, height=72, samples=1)


@lru_cache(maxsize=1)
def visits(config: building.Config = TINY) -> list[tuple[int, int, int]]:
    """(room, first keyframe, last keyframe) of the tours."""
    rooms = [building.room(config, index) for index in range(config.keyframes)]
    found = []
    for room, group in itertools.groupby(enumerate(rooms), key=lambda pair: pair[1]):
        indices = [index for index, _ in group]
        if room is not None:
            found.append((room, indices[0], indices[-1]))
    return found


def tours(room: int) -> list[tuple[int, int]]:
    return [(first, last) for toured, first, last in visits() if toured == room]


def test_it_is_a_camera_of_capture_whose_photographs_are_made_when_they_are_asked_for():
    config = parse_config({"camera": {"kind": "building", "width": 96, "height": 72}}, CaptureConfig)
    assert config.camera.config.keyframes == 1000
    stream = camera_opener(config.camera)()
    first, second = next(stream), next(stream)
    assert isinstance(first, Frame) and isinstance(second, Frame)
    assert first.image.shape == (72, 96, 3) and first.intrinsics is None
    assert (first.name, second.stamp_ns - first.stamp_ns) == ("keyframe_00000.png", 500_000_000)
    assert second.captured_at == Stamp(500_000_000, Clock.RECORDING)
    assert building.frame_index(second.name) == 1


def test_same_seed_same_pixels_and_another_seed_another_building():
    photograph = building.render_image(TINY, 7)
    interior.cache_clear()
    assert np.array_equal(photograph, building.render_image(msgspec.structs.replace(TINY, keyframes=20), 7))
    other = building.render_image(msgspec.structs.replace(TINY, seed=1), 7)
    assert np.abs(photograph.astype(int) - other).mean() > 15


def test_the_camera_goes_in_small_steps_and_stays_in_the_building():
    cameras = [building.scene_camera(TINY, index)[0] for index in range(TINY.keyframes)]
    for T_world_camera in cameras:
        rotation, (x, y, z) = T_world_camera[:3, :3], T_world_camera[:3, 3]
        assert np.allclose(rotation.T @ rotation, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1)
        assert any(zone.holds(x, y) for zone in ZONES) or len(zones_at(x, y)) == 2
        assert 1.1 < z < 1.4
    pairs = list(itertools.pairwise(cameras))
    steps = np.array([np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairs])
    turns = np.degrees([np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1)) for a, b in pairs])
    assert steps.max() < 0.42 and turns.max() < 14
    assert steps[turns > 5].min() > 0.05  # it turns on arcs
    assert np.maximum(steps / 0.25, turns / 8).min() > 0.75


def test_neighbours_show_mostly_the_same():
    shares = [building.measure_shared_surface(TINY, index, index + 1) for index in range(0, 130, 3)]
    assert min(shares) > 0.4 and np.median(shares) > 0.7


def test_rooms_are_toured_again_and_the_corridor_is_walked_both_ways():
    assert all(len(tours(room)) >= 2 for room in range(CORRIDOR))
    x = np.array([building.scene_camera(TINY, index)[0][0, 3] for index in range(TINY.keyframes)])
    y = np.array([building.scene_camera(TINY, index)[0][1, 3] for index in range(TINY.keyframes)])
    steps = np.diff(x)[np.abs(y[:-1]) < 0.5]
    assert (steps > 0.25).sum() > 50 and (steps < -0.25).sum() > 50


def test_a_tour_of_a_room_shows_what_an_earlier_one_showed_and_another_room_does_not():
    (first, last), (again, until), *_ = tours(CHAIR_ROOM)
    earlier, later = range(first + 4, last - 6, 3), range(again, until, 3)
    back = [max(building.measure_shared_surface(TINY, a, b) for b in later) for a in earlier]
    assert min(back) > 0.5
    assert any(building.same_place(TINY, earlier[3], index) for index in later)
    elsewhere = tours(3)[0][0]
    inside, there = range(first, first + 16, 3), range(elsewhere + 8, elsewhere + 26, 3)  # of both, before a door shows
    assert not any(building.measure_shared_surface(TINY, a, b) > 0.1 for a in inside for b in there)


def test_two_rooms_have_one_paper_and_other_arrangements():
    density = building.state(TINY, 0).density
    first, second = (interior(0, density, room) for room in LOOK_ALIKES)
    paper = [max(zone.solids[1].skins, key=lambda skin: skin.size) for zone in (first, second)]
    assert paper[0].shape == paper[1].shape
    grey = [skin.mean(-1).ravel() - skin.mean() for skin in paper]  # the light differs, the leaves do not
    assert grey[0] @ grey[1] / np.linalg.norm(grey[0]) / np.linalg.norm(grey[1]) > 0.5
    centres = [np.array([solid.centre for solid in zone.solids[:80]]) for zone in (first, second)]
    shifts = centres[1] - centres[0]
    assert np.ptp(shifts, axis=0).max() > 0.5


def test_the_chair_stands_elsewhere_when_the_robot_comes_again():
    (first, last), (again, _), *_ = tours(CHAIR_ROOM)
    before, after = building.state(TINY, first + 10), building.state(TINY, again + 10)
    assert (before.chair, building.state(TINY, last + 3).chair, after.chair) == (0, 1, 1)
    camera = building.scene_camera(TINY, 12)
    depths = [building.render_depth(state, camera, 96, 72) for state in (before, after)]
    assert 0.01 < (np.abs(depths[0] - depths[1]) > 0.1).mean() < 0.3


def test_the_mirror_shows_what_a_camera_at_its_glass_sees():
    """The colour at a pixel of the mirror is that of the surface that the reflected ray meets."""
    state = building.state(TINY, 0)
    zone = interior(state.seed, state.density, MIRROR_ROOM)
    assert zone.mirror is not None
    glass = zone.solids[zone.mirror]
    normal = glass.axes[:, 1] / np.linalg.norm(glass.axes[:, 1])
    x, y = ZONES[MIRROR_ROOM].centre
    face = glass.centre + glass.axes[:, 1]
    stand = np.array([0.6 * x + 0.4 * face[0], 0.6 * y + 0.4 * face[1], 1.3])
    camera = look_at(stand, face), building.intrinsic_matrix(TINY)
    colours, z = building.view(state, camera, 96, 72), building.render_depth(state, camera, 96, 72)
    agree = []
    for row, column in itertools.product((24, 36, 44), (36, 44, 52, 60)):
        ray = camera[0][:3, :3] @ np.linalg.inv(camera[1]) @ [column + 0.5, row + 0.5, 1.0]
        point = stand + z[row, column] * ray
        if abs((point - face) @ normal) > 1e-3:
            continue  # beside the mirror
        turned = ray - 2 * (ray @ normal) * normal
        at_glass = (
            look_at(point + 0.001 * normal, point + turned),
            np.array([[400.0, 0, 0.5], [0, 400, 0.5], [0, 0, 1]]),
        )
        seen = building.view(state, at_glass, 1, 1)[0, 0]
        agree.append(np.abs(colours[row, column] - building.SILVER * seen).max() < 8)
    assert len(agree) >= 6 and np.mean(agree) > 0.8


def test_a_mirrored_camera_mirrored_again_is_itself():
    zone = interior(0, building.state(TINY, 0).density, MIRROR_ROOM)
    assert zone.mirror is not None
    camera = building.scene_camera(TINY, 3)
    once = building.mirror_camera(zone.solids[zone.mirror], camera)
    assert np.linalg.det(once[0][:3, :3]) == pytest.approx(-1)
    assert np.allclose(building.mirror_camera(zone.solids[zone.mirror], once)[0], camera[0])


def test_some_keyframes_in_a_row_show_a_blank_wall_and_few():
    first, last = tours(3)[1][1], tours(1)[0][0]  # on the way from one to the other it goes to the blank end
    blank = []
    for index in range(first + 20, last - 20):
        photograph = building.render_image(msgspec.structs.replace(TINY, noise=0.0), index).mean(-1)
        detail = np.abs(np.diff(photograph, axis=1))
        blank.append((detail > 6).mean() < 0.1)
    runs = [len(list(group)) for is_blank, group in itertools.groupby(blank) if is_blank]
    assert len(runs) == 1 and 2 <= runs[0] <= 5


def test_a_held_out_camera_lies_between_its_neighbours():
    before, after = (building.scene_camera(TINY, index)[0][:3, 3] for index in (20, 21))
    held_out = building.evaluation_camera(TINY, 20)[0][:3, 3]
    gap = np.linalg.norm(after - before)
    assert max(np.linalg.norm(held_out - before), np.linalg.norm(held_out - after)) < 0.7 * gap


def test_a_kidnapped_robot_goes_on_in_another_room():
    kidnapped = msgspec.structs.replace(TINY, kidnap_at=30)
    assert np.array_equal(building.render_image(TINY, 29), building.render_image(kidnapped, 29))
    steps = [
        np.linalg.norm(building.scene_camera(config, 30)[0][:3, 3] - building.scene_camera(config, 29)[0][:3, 3])
        for config in (TINY, kidnapped)
    ]
    assert steps[0] < 0.42 and steps[1] > 3
    assert building.room(TINY, 30) != building.room(kidnapped, 30) is not None
    assert building.measure_shared_surface(kidnapped, 29, 30) < 0.05
    assert len([building.scene_camera(kidnapped, index) for index in range(990, 1000)]) == 10
