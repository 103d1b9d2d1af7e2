"""Protobuf and CDR, as their own libraries write them and as no library does; which calibration is a camera's."""

from __future__ import annotations

import struct
import tracemalloc
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatnode.extras.cameras.mcap import Config, image_topics, stream
from splatnode.extras.logged.messages import (
    CALIBRATIONS,
    PICTURES,
    Calibration,
    Cdr,
    Fields,
    Layout,
    Picture,
    UnusableMessage,
    calibration_topic,
    rgb,
)
from tests.support.mcap_files import START_NS, jpeg, write

K = (100.0, 0.0, 31.5, 0.0, 110.0, 23.5, 0.0, 0.0, 1.0)
IMAGE = np.full((48, 64, 3), (200, 100, 50), np.uint8)
HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec"""
IMAGE_TEXT = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step"
INFO_TEXT = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
    "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi"
)
WINDOW_TEXT = (
    f"\n{'=' * 80}\nMSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
    "bool do_rectify"
)


def test_ros_2_topics_of_its_own_writer(tmp_path):
    """A window of 64 x 48 of a sensor of 128 x 96, whose pictures are raw and compressed."""
    writing = pytest.importorskip("mcap_ros2.writer", reason="needs mcap-ros2-support")
    header = SimpleNamespace(stamp=SimpleNamespace(sec=START_NS // 10**9, nanosec=7), frame_id="optical")
    window = SimpleNamespace(x_offset=20, y_offset=10, height=48, width=64, do_rectify=False)
    lens = {"distortion_model": "plumb_bob", "d": [0.1, 0.0, 0.0, 0.0, 0.0], "k": K, "r": K, "p": [0.0] * 12}
    messages: dict[str, tuple[str, str, dict[str, Any]]] = {
        "/cam/camera_info": (
            "sensor_msgs/msg/CameraInfo",
            INFO_TEXT + HEADER + WINDOW_TEXT,
            {"height": 96, "width": 128, **lens, "binning_x": 0, "binning_y": 0, "roi": window},
        ),
        "/cam/image_raw": (
            "sensor_msgs/msg/Image",
            f"{IMAGE_TEXT}\nuint8[] data{HEADER}",
            {
                "height": 48,
                "width": 64,
                "encoding": "bgr8",
                "is_bigendian": 0,
                "step": 192,
                "data": IMAGE[:, :, ::-1].tobytes(),
            },
        ),
        "/cam/image_raw/compressed": (
            "sensor_msgs/msg/CompressedImage",
            f"std_msgs/Header header\nstring format\nuint8[] data{HEADER}",
            {"format": "rgb8; jpeg compressed bgr8", "data": jpeg(IMAGE)},
        ),
    }
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = writing.Writer(file)
        for topic, (schema, text, content) in messages.items():
            known = writer.register_msgdef(schema, text)
            writer.write_message(topic, known, {"header": header, **content}, log_time=START_NS)
        writer.finish()
    assert [topic.name for topic in image_topics(tmp_path / "a.mcap")] == [
        "/cam/image_raw",
        "/cam/image_raw/compressed",
    ]
    for topic in ("/cam/image_raw", "/cam/image_raw/compressed"):
        frame = only(tmp_path / "a.mcap", topic)
        assert (frame.intrinsics.cx, frame.intrinsics.cy) == (31.5 - 20 + 0.5, 23.5 - 10 + 0.5)


def test_foxglove_topics_of_its_own_protobuf(tmp_path):
    schemas = pytest.importorskip("foxglove_schemas_protobuf", reason="needs foxglove-schemas-protobuf").__name__
    CompressedImage = import_module(f"{schemas}.CompressedImage_pb2").CompressedImage
    RawImage = import_module(f"{schemas}.RawImage_pb2").RawImage
    CameraCalibration = import_module(f"{schemas}.CameraCalibration_pb2").CameraCalibration
    picture = CompressedImage(frame_id="optical", data=jpeg(IMAGE), format="jpeg")
    rows = RawImage(frame_id="optical", width=64, height=48, encoding="rgb8", step=192, data=IMAGE.tobytes())
    lens = CameraCalibration(frame_id="optical", width=64, height=48, distortion_model="plumb_bob", D=[0.1, 0, 0], K=K)
    for message in (picture, rows, lens):
        message.timestamp.FromNanoseconds(START_NS + 7)
    topics = {"/cam/image": picture, "/cam/raw": rows, "/cam/calibration": lens}
    told = [
        (topic, f"foxglove.{type(each).__name__}", "protobuf", b"", each.SerializeToString())
        for topic, each in topics.items()
    ]
    file = write(tmp_path / "a.mcap", told)
    for topic in ("/cam/image", "/cam/raw"):
        frame = only(file, topic)
        assert frame.intrinsics.cx == 32.0


def test_an_image_of_one_row_allocates_no_more_than_its_pixels():
    picture = Picture("optical", START_NS, bytes(range(15)), Layout(5, 1, "rgb8", 2**31))
    tracemalloc.start()
    try:
        assert (rgb(picture, 100) == np.arange(15).reshape(1, 5, 3)).all()
        assert tracemalloc.get_traced_memory()[1] < 1 << 20  # of the 2 GB that one step is long
    finally:
        tracemalloc.stop()


def only(file: Path, topic: str) -> Any:
    """The one frame of a topic, which is what was written."""
    frame: Any
    (frame,) = stream(Config(file, topic=topic))
    assert np.abs(frame.image.astype(int) - IMAGE).max() <= 3
    assert frame.captured_at.ns == START_NS + 7 and frame.stamp_ns >= START_NS
    assert (frame.intrinsics.fx, frame.intrinsics.fy, frame.intrinsics.width) == (100.0, 110.0, 64)
    assert frame.intrinsics.distortion[0] == 0.1
    return frame


def test_a_protobuf_message_by_hand():
    data = bytes([0x08, 0x96, 0x01, 0x15, 2, 0, 0, 0, 0x1A, 2]) + b"hi" + bytes([0x22, 16]) + struct.pack("<2d", 1, 2.5)
    fields = Fields(data)
    assert (fields.integer(1), fields.integer(2), fields.text(3), fields.doubles(4)) == (150, 2, "hi", (1.0, 2.5))
    assert (fields.integer(9), fields.bytes(9), fields.doubles(9), fields.message(9).integer(1)) == (0, b"", (), 0)


@pytest.mark.parametrize("order", [(b"\0\0", ">"), (b"\0\1", "<")])
def test_a_cdr_message_by_hand(order):
    head, kind = order
    text = struct.pack(f"{kind}iII", 5, 7, 3) + b"ab\0"
    values = Cdr(head + b"\0\0" + text + b"\x09" + struct.pack(f"{kind}II", 1, 0) + struct.pack(f"{kind}d", 2.5))
    assert (values.time_ns(), values.text(), values.byte()) == (5_000_000_007, "ab", 9)
    assert values.doubles() == (2.5,)  # aligned to 8 bytes behind its length


@given(st.binary(max_size=60), st.sampled_from(sorted({*PICTURES, *CALIBRATIONS})))
def test_any_bytes_are_a_message_or_are_refused(data, kind):
    read = {**PICTURES, **CALIBRATIONS}[kind]
    for sent in (data, b"\0\1\0\0" + data):
        try:
            read(sent)
        except UnusableMessage as error:
            assert str(error)


def test_the_calibration_of_a_camera_is_of_its_sensor_and_lies_deepest():
    def of(sensor: str) -> Calibration:
        return Calibration(sensor, 64, 48, "", (), K, ())

    known = {"/camera_info": of(""), "/front/camera_info": of("a"), "/front/left/camera_info": of("b")}
    assert calibration_topic("/front/left/image", "", known) == "/front/left/camera_info"
    assert calibration_topic("/front/left/image", "a", known) == "/front/camera_info"
    assert calibration_topic("/rear/image", "c", known) == "/camera_info"
    assert calibration_topic("/rear/image", "b", {"/calibrations/b": of("b")}) == "/calibrations/b"
    assert calibration_topic("/rear/image", "", {"/calibrations/b": of("b")}) is None
