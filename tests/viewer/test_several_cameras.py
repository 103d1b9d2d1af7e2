"""Several cameras and given poses, as the viewers show them: a colour for each camera id, a thin frustum, a line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from splatnode.capture.messaging.messages import Message
from splatnode.recon.result.message import decode_snapshot, encode_snapshot
from splatnode.recon.result.snapshot import GivenCameraPose
from splatnode.recon.result.verdict import Scale
from splatnode.viewer import session
from splatnode.viewer.analysis import camera_colours, source_colour
from splatnode.viewer.shapes import shapes
from splatnode.viewer.state import ViewerState
from splatnode.viewer.web import Content
from tests.viewer.test_scene import camera, moment, wall


def make_cameras():
    """Two frame sets of two cameras; the first image has a given pose, 5 cm off."""
    made = [
        replace(camera(0.3 * number, frame_id=number), camera_id=camera_id, frame_set=number // 2)
        for number, camera_id in enumerate(("right", "left", "right", "left"))
    ]
    T = made[0].T_world_camera.copy()
    T[:3, 3] += [0.03, 0.04, 0.0]
    return (replace(made[0], given=GivenCameraPose(T, 0.01, 0.5)), *made[1:])


def test_images_of_one_camera_have_one_colour():
    colours = camera_colours(make_cameras())
    assert colours[0] == colours[2] != colours[1] == colours[3]
    alone = [replace(each, camera_id="") for each in make_cameras()]
    assert camera_colours(alone) == [source_colour(index) for index in range(4)]


def test_a_given_pose_is_a_thin_frustum_with_a_line_to_the_estimated_one():
    there = moment(wall(), *make_cameras(), scale=Scale(True, "poses"))
    only = ViewerState(cameras=False, photographs=False, path=False, advice=False, uncertainty=False, graph=False)
    (lines,) = shapes(there, only, None).lines
    first = make_cameras()[0]
    assert lines.width == 1 and lines.colour == camera_colours(make_cameras())[0]
    assert np.allclose(lines.ends[-1], [first.given.T_world_camera[:3, 3], first.T_world_camera[:3, 3]])
    assert np.allclose(lines.ends[0, 0], first.given.T_world_camera[:3, 3])
    assert shapes(there, replace(only, given=False), None).lines == ()
    assert session.bounds_lines(there) == ["Given poses: 1, at most 5 cm and 0 degrees off (0.png)"]
    assert session.describe_given_poses(there, make_cameras()[1]) == []


def test_the_web_page_gets_both():
    content = Content(moment(wall(), *make_cameras()), None)
    told = json.loads(content.shapes[4 : 4 + int.from_bytes(content.shapes[:4], "little")])
    groups = [each["group"] for each in told["lines"]]
    assert groups.count("cameras") == 4 and groups.count("given") == 1
    assert [tuple(each["colour"]) for each in told["cameras"]] == camera_colours(make_cameras())


def test_a_message_carries_them():
    images = {each.name: np.zeros((80, 100, 3), np.uint8) for each in make_cameras()}
    snapshot = moment(wall(), *make_cameras(), images=images).snapshot
    header, arrays = encode_snapshot(snapshot, "s", {"session": "a", "sequence": 1, "mono_ns": 1})
    back = decode_snapshot(Message(header, tuple(arrays))).snapshot.cameras
    assert [(each.camera_id, each.frame_set) for each in back] == [
        ("right", 0),
        ("left", 0),
        ("right", 1),
        ("left", 1),
    ]
    assert np.array_equal(back[0].given.T_world_camera, make_cameras()[0].given.T_world_camera)
    assert back[0].given.sigma_m == 0.01 and back[1].given is None
