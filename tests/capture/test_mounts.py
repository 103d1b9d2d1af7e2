"""Where a camera stands on the robot's base: in configurations, rig files, recordings and messages."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture import cli, recording
from splatnode.capture.config import CaptureConfig, camera_opener, mount_camera
from splatnode.capture.frame import DroppedFrame, Frame, make_frame, make_rigid
from splatnode.capture.messaging.messages import FrameHeader, arrays_of, describe_stored_frame, frame_in
from splatnode.capture.process.config import ConfigError, parse_config
from splatnode.capture.rig import Rig, RigCamera, UnusableRig, read_rig

ROWS = [[0.0, 0.0, 1.0, 0.3], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.2], [0.0, 0.0, 0.0, 1.0]]
NUMBERS = tuple(number for row in ROWS for number in row)
CAMERA = {"kind": "synthetic", "views": 2, "width": 64, "height": 48}


def test_a_camera_is_mounted_as_its_configuration_says():
    config = parse_config({"camera": CAMERA, "T_base_camera": ROWS}, CaptureConfig)
    frames = list(mount_camera(camera_opener(config.camera), config.T_base_camera)())
    assert [frame.T_base_camera for frame in frames if isinstance(frame, Frame)] == [NUMBERS, NUMBERS]
    first = frames[0]
    assert isinstance(first, Frame)
    np.testing.assert_array_equal(first.mount, ROWS)
    opened = camera_opener(config.camera)
    assert mount_camera(opened, None) is opened


def test_each_of_several_cameras_has_its_own_mount():
    raw = {"cameras": {"left": {**CAMERA, "T_base_camera": ROWS}, "right": CAMERA}}
    left, right = (parse_config(cli.choose_camera(raw, each), CaptureConfig) for each in ("left", "right"))
    assert left.T_base_camera == tuple(map(tuple, ROWS)) and right.T_base_camera is None


@pytest.mark.parametrize("rows", [np.zeros((4, 4)), np.diag([1.0, 1.0, -1.0, 1.0]), 1e9 * np.eye(4)])
def test_a_mount_that_is_no_rigid_motion_is_refused(rows):
    with pytest.raises(ConfigError, match="T_base_camera must be"):
        parse_config({"camera": CAMERA, "T_base_camera": rows.tolist()}, CaptureConfig)
    made = make_frame(0, "a", 0, np.zeros((4, 4, 3), np.uint8), None, T_base_camera=tuple(rows.ravel().tolist()))
    assert isinstance(made, DroppedFrame) and "T_base_camera must be" in made.reason


def test_recordings_and_messages_keep_the_mount(tmp_path):
    frame = Frame(0, "a.png", 5, np.full((48, 64, 3), 90, np.uint8), None, T_base_camera=NUMBERS)
    with recording.Recorder(tmp_path / "new") as recorder:
        recorder.write(frame)
    (again,) = list(recording.read(tmp_path / "new").frames())
    assert isinstance(again, Frame) and again.T_base_camera == NUMBERS
    header = FrameHeader(session="0" * 32, sequence=0, mono_ns=0, frame_id=0, **describe_stored_frame(frame))
    assert frame_in(header, 0, arrays_of(frame)).T_base_camera == NUMBERS


def write(path: Path, cameras: dict) -> Path:
    path.write_text(json.dumps({"cameras": cameras}))
    return path


def test_a_rig_file_tells_mounts_of_one_camera_or_more(tmp_path):
    one = read_rig(write(tmp_path / "one.yaml", {"front": {"T_base_camera": ROWS}}))
    assert one.is_base and one.find_mount("") == one.find_mount("front") == NUMBERS and one.find_mount("left") is None
    two = read_rig(write(tmp_path / "two.yaml", {"front": {"T_base_camera": ROWS}, "left": {}}))
    assert two.find_mount("front") == NUMBERS and two.find_mount("left") is None and two.find_mount("") is None
    plain = read_rig(write(tmp_path / "rig.yaml", {"front": {"T_rig_camera": ROWS}, "left": {}}))
    assert not plain.is_base and plain.find_mount("front") is None
    with pytest.raises(UnusableRig, match="left has T_base_camera and front T_rig_camera"):
        read_rig(write(tmp_path / "a.yaml", {"front": {"T_rig_camera": ROWS}, "left": {"T_base_camera": ROWS}}))
    with pytest.raises(ValueError, match="A single camera is one by its T_base_camera"):
        Rig((RigCamera("front", NUMBERS),))


def test_a_rounded_rotation_becomes_one():
    rough = np.array(ROWS) + 1e-3
    exact = make_rigid(rough)
    np.testing.assert_allclose(exact[:3, :3] @ exact[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(exact, rough, atol=5e-3)
    np.testing.assert_array_equal(exact[3], [0, 0, 0, 1])
