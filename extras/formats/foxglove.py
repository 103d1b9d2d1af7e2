"""Foxglove's messages about cameras and scenes, as JSON, and an MCAP file of them.

Source: Foxglove's well-known schemas. The top-left pixel's centre is at (0, 0) there, as in ROS.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.placement import quats_from_matrices
from splatnode.recon.result.snapshot import CameraEstimate

_NS = 1_000_000_000
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])

_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_INTEGER, _BYTES = {"type": "integer"}, {"type": "string", "contentEncoding": "base64"}
_NUMBERS = {"type": "array", "items": _NUMBER}


def _make_object_schema(**properties: object) -> dict[str, object]:
    return {"type": "object", "properties": properties}


def _make_array_schema(items: object) -> dict[str, object]:
    return {"type": "array", "items": items}


_TIME = _make_object_schema(sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _make_object_schema(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _make_object_schema(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _make_object_schema(position=_VECTOR, orientation=_QUATERNION)
_TRANSFORM = _make_object_schema(
    timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION
)
_FIELD = _make_object_schema(name=_TEXT, offset=_INTEGER, type=_INTEGER)

SCHEMAS = {
    "FrameTransforms": _make_object_schema(transforms=_make_array_schema(_TRANSFORM)),
    "PoseInFrame": _make_object_schema(timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
    "CameraCalibration": _make_object_schema(
        timestamp=_TIME,
        frame_id=_TEXT,
        width=_INTEGER,
        height=_INTEGER,
        distortion_model=_TEXT,
        D=_NUMBERS,
        K=_NUMBERS,
        R=_NUMBERS,
        P=_NUMBERS,
    ),
    "CompressedImage": _make_object_schema(timestamp=_TIME, frame_id=_TEXT, data=_BYTES, format=_TEXT),
    "PointCloud": _make_object_schema(
        timestamp=_TIME,
        frame_id=_TEXT,
        pose=_POSE,
        point_stride=_INTEGER,
        fields=_make_array_schema(_FIELD),
        data=_BYTES,
    ),
    "Log": _make_object_schema(timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER),
}

Message = tuple[str, int, dict[str, object]]  # topic, nanoseconds, content


def encode_mcap(make_writer: Callable, messages: Sequence[Message], schemas: Mapping[str, str]) -> bytes:
    """An MCAP file of the messages, by a Writer of mcap; `schemas` names that of each topic."""
    file = io.BytesIO()
    writer = make_writer(file)
    writer.start(library="splatnode")
    add_messages(writer, messages, schemas)
    writer.finish()
    return file.getvalue()


def add_messages(writer: Any, messages: Sequence[Message], schemas: Mapping[str, str]) -> None:
    """Adds the messages to a Writer of mcap that was started; `schemas` names that of each topic."""
    channels = {}
    for topic in dict.fromkeys(topic for topic, _, _ in messages):
        name = schemas[topic]
        titled = json.dumps({"title": f"foxglove.{name}", **SCHEMAS[name]}).encode()
        known = writer.register_schema(f"foxglove.{name}", "jsonschema", titled)
        channels[topic] = writer.register_channel(topic, "json", known)
    for topic, ns, content in messages:
        writer.add_message(channels[topic], log_time=ns, publish_time=ns, data=json.dumps(content).encode())


def make_calibration(camera: CameraEstimate, ns: int, frame: str) -> dict[str, object]:
    """A CameraCalibration: a pinhole, for the image at modelled size."""
    K = camera.K - _HALF_PIXEL
    return {
        "timestamp": make_time(ns),
        "frame_id": frame,
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "plumb_bob",
        "D": [0.0] * 5,
        "K": K.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    }


def make_pose(T_world_camera: npt.NDArray[np.float64]) -> dict[str, dict[str, float]]:
    w, x, y, z = (float(value) for value in quats_from_matrices(T_world_camera[:3, :3]))
    position = dict(zip("xyz", T_world_camera[:3, 3].tolist(), strict=True))
    return {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}


def make_time(ns: int) -> dict[str, int]:
    return {"sec": ns // _NS, "nsec": ns % _NS}


def encode_base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
