"""Static transforms of a log become a rig: of ROS 2, and of Foxglove in JSON and protobuf."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from splatnode.capture.film import select_cameras
from splatnode.extras.logged.messages import UnusableMessage
from splatnode.extras.logged.transforms import (
    parse_frame_transforms_protobuf,
    parse_tf_message,
    read_static_transforms,
)
from tests.support import mcap_files

OPTICAL = (-0.5, 0.5, -0.5, 0.5)  # of a camera that looks along x of its robot: REP 103
IMAGE = np.full((48, 64, 3), 90, np.uint8)


def transform(parent, child, shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0, 1.0)):
    told = {
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": dict(zip("xyz", shift, strict=True)),
        "rotation": dict(zip("xyzw", turn, strict=True)),
    }
    return mcap_files.as_json("/tf", "FrameTransform", told)


def shot(camera):
    return mcap_files.compressed(f"/{camera}/image", IMAGE, sensor=f"{camera}_optical")


def tf_bytes(*rows):
    """tf2_msgs/TFMessage in CDR."""
    data = struct.pack("<I", len(rows))

    def text(value):
        nonlocal data
        data += bytes(-len(data) % 4) + struct.pack("<I", len(value) + 1) + value.encode() + b"\0"

    for parent, child, shift, turn in rows:
        data += bytes(-len(data) % 4) + struct.pack("<iI", 5, 6)
        text(parent)
        text(child)
        data += bytes(-len(data) % 8) + struct.pack("<7d", *shift, *turn)
    return b"\0\1\0\0" + data


def test_a_tree_of_transforms_is_a_rig(tmp_path):
    messages = [
        transform("base_link", "mast", (0.0, 0.0, 1.0)),
        transform("mast", "left_optical", (0.1, 0.06, 0.0), OPTICAL),
        transform("mast", "right_optical", (0.1, -0.06, 0.0), OPTICAL),
        transform("odom", "base_link", (0.0, 0.0, 0.0)),
        shot("left"),
        shot("right"),
        transform("odom", "base_link", (1.0, 0.0, 0.0)),
    ]
    file = mcap_files.write(tmp_path / "drive.mcap", messages)
    rig = select_cameras([file]).find_rig()
    left, right = (rig.find_camera(camera).matrix for camera in ("left", "right"))
    np.testing.assert_allclose(left[:3, 3], [0.1, 0.06, 1.0], atol=1e-12)
    np.testing.assert_allclose(left[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # it looks along the robot's x
    np.testing.assert_allclose(left[:3, :3] @ [0, 1, 0], [0, 0, -1], atol=1e-12)  # down is down
    np.testing.assert_allclose(np.linalg.inv(left) @ right @ [0, 0, 0, 1], [0.12, 0, 0, 1], atol=1e-12)


def test_what_ros_2_writes_is_read(tmp_path):
    data = tf_bytes(("base", "a_optical", (1.0, 2.0, 3.0), OPTICAL), ("base", "bb_optical", (0.0, 0.0, 1.0), OPTICAL))
    found = parse_tf_message(data)
    assert [(each.parent, each.child, each.translation) for each in found] == [
        ("base", "a_optical", (1.0, 2.0, 3.0)),
        ("base", "bb_optical", (0.0, 0.0, 1.0)),
    ]
    schema = "tf2_msgs/msg/TFMessage"
    written = [
        ("/tf_static", schema, "ros2msg", b"", data),
        ("/tf", schema, "ros2msg", b"", tf_bytes(("odom", "base", (0.0, 0.0, 0.0), OPTICAL))),
        shot("a"),
        shot("bb"),
    ]
    file = mcap_files.write(tmp_path / "bag.mcap", written)
    assert set(read_static_transforms(file)) == {"a_optical", "bb_optical"}
    assert select_cameras([file]).find_rig().find_camera("a").matrix[:3, 3].tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(UnusableMessage, match="ends within"):
        parse_tf_message(data[:60])


TF_TEXT = "geometry_msgs/TransformStamped[] transforms" + "".join(
    f"\n{'=' * 80}\nMSG: {name}\n{text}"
    for name, text in {
        "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\nTransform transform",
        "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation",
        "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
        "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
        "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
        "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    }.items()
)


def test_what_an_own_writer_of_ros_2_writes_is_read(tmp_path):
    writing = pytest.importorskip("mcap_ros2.writer", reason="needs mcap-ros2-support")
    moved = {"translation": {"x": 1.0, "y": 2.0, "z": 3.0}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "base"}
    each = [{"header": header, "child_frame_id": child, "transform": moved} for child in ("cam", "camera_b")]
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = writing.Writer(file)
        known = writer.register_msgdef("tf2_msgs/msg/TFMessage", TF_TEXT)
        writer.write_message("/tf_static", known, {"transforms": each}, log_time=mcap_files.START_NS)
        writer.finish()
    found = read_static_transforms(tmp_path / "a.mcap").values()
    assert [(one.child, one.translation) for one in found] == [
        ("cam", (1.0, 2.0, 3.0)),
        ("camera_b", (1.0, 2.0, 3.0)),
    ]


def test_foxglove_protobuf():
    def field(number, data):
        return bytes([number << 3 | 2, len(data)]) + data

    def double(number, value):
        return bytes([number << 3 | 1]) + struct.pack("<d", value)

    one = field(2, b"base") + field(3, b"cam") + field(4, double(1, 2.5)) + field(5, double(4, 1.0))
    found = parse_frame_transforms_protobuf(field(1, one) + field(1, one.replace(b"cam", b"eye")))
    assert [(each.child, each.translation, each.rotation) for each in found] == [
        ("cam", (2.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        ("eye", (2.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
    ]


def test_cameras_that_no_static_transform_places_are_named(tmp_path):
    file = mcap_files.write(tmp_path / "a.mcap", [transform("base", "left_optical"), shot("left"), shot("right")])
    with pytest.raises(ValueError, match="where the camera right stands: its images name the frame 'right_optical'"):
        select_cameras([file]).find_rig()
    apart = [transform("base", "left_optical"), transform("arm", "right_optical"), shot("left"), shot("right")]
    with pytest.raises(ValueError, match="cameras that move to each other"):
        select_cameras([mcap_files.write(tmp_path / "b.mcap", apart)]).find_rig()
    circle = [transform("left_optical", "base"), transform("base", "left_optical"), shot("left"), shot("right")]
    with pytest.raises(ValueError, match="must be a tree"):
        select_cameras([mcap_files.write(tmp_path / "c.mcap", circle)]).find_rig()
    wrong = [transform("base", "left_optical", turn=(0.0, 0.0, 0.0, 0.0)), shot("left"), shot("right")]
    wrong += [transform("base", "left_optical", turn=(0.0, 0.0, 0.0, 0.0))]
    with pytest.raises(UnusableMessage, match="no rigid motion"):
        select_cameras([mcap_files.write(tmp_path / "d.mcap", wrong)]).find_rig()
