"""MCAP files as robots write them: pictures and calibrations by Foxglove's schemas and by ROS 2's."""

from __future__ import annotations

import base64
import json
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
