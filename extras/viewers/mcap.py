"""An MCAP file for Foxglove: for each photograph its camera, calibration and picture, and the scene as points.

The times are those of capture where all photographs have one of the same clock; else the frames are a second apart. The
world is the first camera's frame: y is down.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import compute_base_rgb
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.placement import quats_from_matrices
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.stored_snapshot import encode_image, load_full_snapshot

# Foxglove's messages about cameras and scenes, as JSON, and an MCAP file of them.
#
# Source: Foxglove's well-known schemas. The top-left pixel's centre is at (0, 0) there, as in ROS.

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


DEFAULT_NAME = "scene.mcap"

_WORLD, _CAMERA = "world", "camera"
_UINT8, _FLOAT32 = 1, 7  # Foxglove's numbers of types
_INFO, _WARNING = 2, 3  # and of levels
_SCHEMAS = {  # by topic
    "/tf": "FrameTransforms",
    "/camera/pose": "PoseInFrame",
    "/camera/calibration": "CameraCalibration",
    "/camera/image": "CompressedImage",
    "/gaussians": "PointCloud",
    "/landmarks": "PointCloud",
    "/verdict": "Log",
}


def export(result: StoredResult) -> bytes:
    """Raises ModuleNotFoundError without the package mcap."""
    from mcap.writer import Writer  # an extra

    return encode_mcap(Writer, _make_messages(load_full_snapshot(result)), _SCHEMAS)


def _make_messages(snapshot: Snapshot) -> list[Message]:
    """In the order of time. What holds for the whole scene comes with its first photograph."""
    times = _choose_times(snapshot.cameras)
    began = min(times, default=0)
    found = _make_scene_messages(snapshot, began)
    for ns, camera in sorted(zip(times, snapshot.cameras, strict=True), key=lambda each: each[0]):
        found += _make_image_messages(camera, encode_image(camera, snapshot.images), ns)
    return found


def _choose_times(cameras: Sequence[CameraEstimate]) -> list[int]:
    stamps = [camera.captured_at for camera in cameras if camera.captured_at is not None]
    if len(stamps) == len(cameras) and len({stamp.clock for stamp in stamps}) == 1:
        return [stamp.ns for stamp in stamps]
    return [camera.frame_id * _NS for camera in cameras]


def _make_scene_messages(snapshot: Snapshot, ns: int) -> list[Message]:
    verdict, gaussians, landmarks = snapshot.verdict, snapshot.gaussians, snapshot.landmarks
    said = " ".join(part for part in (f"{verdict.code.value}:", verdict.message, verdict.advice) if part)
    said += f" Lengths are {snapshot.scale.sentence}. The frame is {snapshot.scale.frame.sentence}."
    level = _INFO if verdict.publishable else _WARNING
    log = {"timestamp": make_time(ns), "level": level, "message": said, "name": "splatnode", "file": "", "line": 0}
    found: list[Message] = [("/verdict", ns, log)]
    if len(gaussians):
        alpha = np.rint(255 * gaussians.opacities).astype(np.uint8)
        found.append(
            ("/gaussians", ns, _make_cloud(gaussians.means, np.column_stack([compute_base_rgb(gaussians), alpha]), ns))
        )
    if landmarks is not None:
        found.append(("/landmarks", ns, _make_cloud(landmarks.points, None, ns)))
    return found


def _make_image_messages(camera: CameraEstimate, jpeg: bytes | None, ns: int) -> list[Message]:
    stamp, placed = make_time(ns), make_pose(camera.T_world_camera)
    transform = {
        "timestamp": stamp,
        "parent_frame_id": _WORLD,
        "child_frame_id": _CAMERA,
        "translation": placed["position"],
        "rotation": placed["orientation"],
    }
    found: list[Message] = [
        ("/tf", ns, {"transforms": [transform]}),
        ("/camera/pose", ns, {"timestamp": stamp, "frame_id": _WORLD, "pose": placed}),
        ("/camera/calibration", ns, make_calibration(camera, ns, _CAMERA)),
    ]
    if jpeg is not None:
        image = {"timestamp": stamp, "frame_id": _CAMERA, "data": encode_base64(jpeg), "format": "jpeg"}
        found.append(("/camera/image", ns, image))
    return found


def _make_cloud(points: npt.NDArray, rgba: npt.NDArray[np.uint8] | None, ns: int) -> dict[str, object]:
    names = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    colours = [] if rgba is None else [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")]
    packed = np.empty(len(points), np.dtype(names + colours))
    for axis, (name, _) in enumerate(names):
        packed[name] = points[:, axis]
    for channel, (name, _) in enumerate(colours):
        packed[name] = rgba[:, channel] if rgba is not None else 0
    offsets = packed.dtype.fields or {}
    fields = [
        {"name": name, "offset": offsets[name][1], "type": _FLOAT32 if kind == "<f4" else _UINT8}
        for name, kind in names + colours
    ]
    return {
        "timestamp": make_time(ns),
        "frame_id": _WORLD,
        "pose": make_pose(np.eye(4)),
        "point_stride": packed.dtype.itemsize,
        "fields": fields,
        "data": encode_base64(packed.tobytes()),
    }
