"""MCAP files as robots write them: pictures and calibrations by Foxglove's schemas and by ROS 2's."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from mcap.writer import Writer

START_NS = 1_700_000_000 * 10**9  # the time of the first message, in November 2023
STEP_NS = 100_000_000  # between messages

Written = tuple[str, str, str, bytes, bytes]  # topic, schema's name and encoding, its definition, a message


def write(file: Path, messages: Iterable[Written], log_ns: Callable[[int], int] | None = None, **options: Any) -> Path:
    """The messages, 0.1 s apart or logged at `log_ns` of their numbers, in a file of mcap's own writer."""
    encodings = {"jsonschema": "json", "protobuf": "protobuf", "ros2msg": "cdr"}
    with file.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        channels: dict[str, int] = {}
        for index, (topic, schema, kind, definition, data) in enumerate(messages):
            if topic not in channels:
                known = writer.register_schema(schema, kind, definition)
                channels[topic] = writer.register_channel(topic, encodings[kind], known)
            at_ns = START_NS + STEP_NS * index if log_ns is None else log_ns(index)
            writer.add_message(channels[topic], log_time=at_ns, publish_time=at_ns, data=data)
        writer.finish()
    return file


def jpeg(image: npt.NDArray[np.uint8]) -> bytes:
    """A picture (H, W, 3) RGB as a file that loses little."""
    return cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()


def compressed(
    topic: str, image: npt.NDArray[np.uint8] | bytes, sensor: str = "", header_ns: int | None = None
) -> Written:
    data = image if isinstance(image, bytes) else jpeg(image)
    told = {"data": _base64(data), "format": "jpeg", "frame_id": sensor}
    stamp = {} if header_ns is None else {"timestamp": {"sec": header_ns // 10**9, "nsec": header_ns % 10**9}}
    return as_json(topic, "CompressedImage", {**told, **stamp})


def raw(topic: str, width: int, height: int, encoding: str, step: int, data: bytes, sensor: str = "") -> Written:
    told = {"width": width, "height": height, "encoding": encoding, "step": step, "data": _base64(data)}
    return as_json(topic, "RawImage", {**told, "frame_id": sensor})


def calibration(
    topic: str,
    size: tuple[int, int],
    K: Sequence[float],
    D: Sequence[float] = (),
    model: str = "plumb_bob",
    sensor: str = "",
    P: Sequence[float] = (),
) -> Written:
    told = {"width": size[0], "height": size[1], "K": list(K), "D": list(D), "P": list(P)}
    return as_json(topic, "CameraCalibration", {**told, "distortion_model": model, "frame_id": sensor})


def as_json(topic: str, name: str, content: dict[str, Any]) -> Written:
    """A message of one of Foxglove's schemas."""
    stamped = {"timestamp": {"sec": START_NS // 10**9, "nsec": 500}, **content}
    schema = json.dumps({"type": "object", "title": f"foxglove.{name}"}).encode()
    return topic, f"foxglove.{name}", "jsonschema", schema, json.dumps(stamped).encode()


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


# ROS 2's messages, whose values are each aligned to their size (plain CDR, little endian).


class CdrWriter:
    def __init__(self) -> None:
        self._body = b""

    def add(self, kind: str, *numbers: float) -> CdrWriter:
        size = struct.calcsize(f"<{kind}")
        self._body += bytes(-len(self._body) % size) + struct.pack(f"<{len(numbers)}{kind}", *numbers)
        return self

    def add_text(self, text: str) -> CdrWriter:
        return self.add_bytes(text.encode() + b"\0")

    def add_bytes(self, data: bytes) -> CdrWriter:
        self.add("I", len(data))
        self._body += data
        return self

    def add_header(self, ns: int, sensor: str) -> CdrWriter:
        return self.add("i", ns // 10**9).add("I", ns % 10**9).add_text(sensor)

    @property
    def message(self) -> bytes:
        return b"\0\1\0\0" + self._body


def ros_image(
    topic: str, values: npt.NDArray[Any], encoding: str, sensor: str, ns: int, big_endian: bool = False
) -> Written:
    """sensor_msgs/Image of an array (H, W) or (H, W, C), whose numbers are written in this order."""
    height, width = values.shape[:2]
    data = values.astype(values.dtype.newbyteorder(">" if big_endian else "<")).tobytes()
    to = CdrWriter().add_header(ns, sensor).add("I", height, width).add_text(encoding).add("B", big_endian)
    return topic, "sensor_msgs/msg/Image", "ros2msg", b"", to.add("I", len(data) // height).add_bytes(data).message


def ros_file(topic: str, data: bytes, told: str, sensor: str, ns: int) -> Written:
    """sensor_msgs/CompressedImage, whose format is `told`."""
    message = CdrWriter().add_header(ns, sensor).add_text(told).add_bytes(data).message
    return topic, "sensor_msgs/msg/CompressedImage", "ros2msg", b"", message


def pack_depth(values: npt.NDArray[Any], a: float = 0.0, b: float = 0.0) -> bytes:
    """As ROS' compressedDepth: its head, and a PNG of 16 bits."""
    return struct.pack("<iff", int(a > 0), a, b) + cv2.imencode(".png", values)[1].tobytes()


def ros_lens(topic: str, size: tuple[int, int], K: Sequence[float], sensor: str, ns: int = START_NS) -> Written:
    """sensor_msgs/CameraInfo of a pinhole."""
    to = CdrWriter().add_header(ns, sensor).add("I", size[1], size[0]).add_text("plumb_bob").add("I", 5)
    to.add("d", *[0.0] * 5).add("d", *K).add("d", 1, 0, 0, 0, 1, 0, 0, 0, 1)
    to.add("d", *K[:3], 0, *K[3:6], 0, *K[6:9], 0).add("I", 0, 0, 0, 0, 0, 0).add("B", 0)
    return topic, "sensor_msgs/msg/CameraInfo", "ros2msg", b"", to.message


def ros_static(*links: tuple[str, str, Sequence[float], Sequence[float]]) -> Written:
    """tf2_msgs/TFMessage on /tf_static: parent, child, x y z in metres, quaternion x y z w."""
    to = CdrWriter().add("I", len(links))
    for parent, child, shift, turn in links:
        to.add_header(START_NS, parent).add_text(child).add("d", *shift, *turn)
    return "/tf_static", "tf2_msgs/msg/TFMessage", "ros2msg", b"", to.message
