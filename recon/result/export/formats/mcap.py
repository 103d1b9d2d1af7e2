"""An MCAP file for Foxglove: for each photograph its camera, calibration and picture, and the scene as points.

The schemas are Foxglove's well-known ones, as JSON. The times are those of capture where all photographs have one
of the same clock; else the frames are a second apart. The world is the first camera's frame: y is down.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.prepare import base_rgb
from splatnode.recon.result.export.quaternions import quats_from_matrices
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.stored_snapshot import photograph_of, recorded_snapshot

DEFAULT_NAME = "scene.mcap"

_NS = 1_000_000_000
_WORLD, _CAMERA = "world", "camera"
_UINT8, _FLOAT32 = 1, 7  # Foxglove's numbers of types
_INFO, _WARNING = 2, 3  # and of levels
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # ROS and Foxglove: the top-left pixel is at (0, 0)

_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_INTEGER, _BYTES = {"type": "integer"}, {"type": "string", "contentEncoding": "base64"}
_NUMBERS = {"type": "array", "items": _NUMBER}


def _object(**properties: object) -> dict[str, object]:
    return {"type": "object", "properties": properties}


def _array(items: object) -> dict[str, object]:
    return {"type": "array", "items": items}


_TIME = _object(sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object(position=_VECTOR, orientation=_QUATERNION)
_TRANSFORM = _object(
    timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION
)
_FIELD = _object(name=_TEXT, offset=_INTEGER, type=_INTEGER)

_SCHEMAS = {  # by topic
    "/tf": ("FrameTransforms", _object(transforms=_array(_TRANSFORM))),
    "/camera/pose": ("PoseInFrame", _object(timestamp=_TIME, frame_id=_TEXT, pose=_POSE)),
    "/camera/calibration": (
        "CameraCalibration",
        _object(
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
    ),
    "/camera/image": ("CompressedImage", _object(timestamp=_TIME, frame_id=_TEXT, data=_BYTES, format=_TEXT)),
    **dict.fromkeys(
        ("/gaussians", "/landmarks"),
        (
            "PointCloud",
            _object(
                timestamp=_TIME, frame_id=_TEXT, pose=_POSE, point_stride=_INTEGER, fields=_array(_FIELD), data=_BYTES
            ),
        ),
    ),
    "/verdict": (
        "Log",
        _object(timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER),
    ),
}

Message = tuple[str, int, dict[str, object]]  # topic, nanoseconds, content


def export(result: StoredResult) -> bytes:
    """Raises ModuleNotFoundError without the package mcap."""
    from mcap.writer import Writer  # an extra

    return _written(Writer, _messages(recorded_snapshot(result)))


def _written(make_writer: Callable, messages: Sequence[Message]) -> bytes:
    file = io.BytesIO()
    writer = make_writer(file)
    writer.start(library="splatnode")
    channels = {}
    for topic in dict.fromkeys(topic for topic, _, _ in messages):
        name, schema = _SCHEMAS[topic]
        titled = json.dumps({"title": f"foxglove.{name}", **schema}).encode()
        known = writer.register_schema(f"foxglove.{name}", "jsonschema", titled)
        channels[topic] = writer.register_channel(topic, "json", known)
    for topic, ns, content in messages:
        writer.add_message(channels[topic], log_time=ns, publish_time=ns, data=json.dumps(content).encode())
    writer.finish()
    return file.getvalue()


def _messages(snapshot: Snapshot) -> list[Message]:
    """In the order of time. What holds for the whole scene comes with its first photograph."""
    times = _times(snapshot.cameras)
    began = min(times, default=0)
    found = _scene(snapshot, began)
    for ns, camera in sorted(zip(times, snapshot.cameras, strict=True), key=lambda each: each[0]):
        found += _photograph(camera, photograph_of(camera, snapshot.images), ns)
    return found


def _times(cameras: Sequence[CameraEstimate]) -> list[int]:
    stamps = [camera.captured_at for camera in cameras if camera.captured_at is not None]
    if len(stamps) == len(cameras) and len({stamp.clock for stamp in stamps}) == 1:
        return [stamp.ns for stamp in stamps]
    return [camera.frame_id * _NS for camera in cameras]


def _scene(snapshot: Snapshot, ns: int) -> list[Message]:
    verdict, gaussians, landmarks = snapshot.verdict, snapshot.gaussians, snapshot.landmarks
    said = " ".join(part for part in (f"{verdict.code.value}:", verdict.message, verdict.advice) if part)
    said += f" Lengths are {snapshot.scale.sentence}."
    level = _INFO if verdict.publishable else _WARNING
    log = {"timestamp": _time(ns), "level": level, "message": said, "name": "splatnode", "file": "", "line": 0}
    found: list[Message] = [("/verdict", ns, log)]
    if len(gaussians):
        alpha = np.rint(255 * gaussians.opacities).astype(np.uint8)
        found.append(("/gaussians", ns, _cloud(gaussians.means, np.column_stack([base_rgb(gaussians), alpha]), ns)))
    if landmarks is not None:
        found.append(("/landmarks", ns, _cloud(landmarks.points, None, ns)))
    return found


def _photograph(camera: CameraEstimate, jpeg: bytes | None, ns: int) -> list[Message]:
    stamp, pose = _time(ns), _pose(camera.T_world_camera)
    transform = {
        "timestamp": stamp,
        "parent_frame_id": _WORLD,
        "child_frame_id": _CAMERA,
        "translation": pose["position"],
        "rotation": pose["orientation"],
    }
    K = camera.K - _HALF_PIXEL
    calibration = {
        "timestamp": stamp,
        "frame_id": _CAMERA,
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "plumb_bob",
        "D": [0.0] * 5,
        "K": K.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    }
    found: list[Message] = [
        ("/tf", ns, {"transforms": [transform]}),
        ("/camera/pose", ns, {"timestamp": stamp, "frame_id": _WORLD, "pose": pose}),
        ("/camera/calibration", ns, calibration),
    ]
    if jpeg is not None:
        image = {"timestamp": stamp, "frame_id": _CAMERA, "data": _base64(jpeg), "format": "jpeg"}
        found.append(("/camera/image", ns, image))
    return found


def _cloud(points: npt.NDArray, rgba: npt.NDArray[np.uint8] | None, ns: int) -> dict[str, object]:
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
        "timestamp": _time(ns),
        "frame_id": _WORLD,
        "pose": _pose(np.eye(4)),
        "point_stride": packed.dtype.itemsize,
        "fields": fields,
        "data": _base64(packed.tobytes()),
    }


def _pose(T_world_camera: npt.NDArray[np.float64]) -> dict[str, dict[str, float]]:
    w, x, y, z = (float(value) for value in quats_from_matrices(T_world_camera[:3, :3]))
    position = dict(zip("xyz", T_world_camera[:3, 3].tolist(), strict=True))
    return {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _time(ns: int) -> dict[str, int]:
    return {"sec": ns // _NS, "nsec": ns % _NS}


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
