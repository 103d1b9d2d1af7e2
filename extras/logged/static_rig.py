"""Where the cameras of a log stand to each other: its static transforms, as a Rig.

A camera is found by the coordinate frame that its images name, which is its optical frame: z forward, x right, y down
(ROS' REP 103). The rig's frame is the root of the tree of static transforms, such as base_link.
Sources: tf2_msgs/TFMessage and geometry_msgs of ROS 2; Foxglove's FrameTransform and FrameTransforms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.process.records import record_in
from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.capture.rig import Rig, RigCamera
from splatnode.extras.logged.mcap import Topic, messages, topics
from splatnode.extras.logged.messages import Cdr, Fields, UnusableMessage, read_picture

_STATIC = "tf_static"  # the last part of the topic on which ROS says what does not move
_MOST_FRAMES = 10_000  # coordinate frames of a log
_SAME = 1e-6  # metres, and sines of angles: a transform that changes by less stands still
_LEAST_NORM = 1e-6  # of a quaternion

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Transform:
    """A transform between two coordinate frames, as it is sent: T_parent_child in metres."""

    parent: str
    child: str
    translation: tuple[float, ...]  # x, y, z
    rotation: tuple[float, ...]  # quaternion x, y, z, w

    @property
    def matrix(self) -> Array:
        """T_parent_child (4, 4). Raises UnusableMessage where it is no rigid motion."""
        quaternion, T = np.array(self.rotation), np.eye(4)
        norm = float(np.linalg.norm(quaternion))
        if not (np.isfinite([*self.translation, norm]).all() and norm > _LEAST_NORM):
            raise UnusableMessage(f"the transform of {sanitize_text(self.child, 100)} is no rigid motion")
        T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        T[:3, 3] = self.translation
        return T


class _Vector(msgspec.Struct, frozen=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class _Quaternion(msgspec.Struct, frozen=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 0.0


class _FrameTransform(msgspec.Struct, frozen=True):
    parent_frame_id: str
    child_frame_id: str
    translation: _Vector = _Vector()
    rotation: _Quaternion = _Quaternion(w=1.0)

    @property
    def transform(self) -> Transform:
        shift, turn = (msgspec.structs.astuple(each) for each in (self.translation, self.rotation))
        return Transform(self.parent_frame_id, self.child_frame_id, shift, turn)


class _FrameTransforms(msgspec.Struct, frozen=True):
    transforms: tuple[_FrameTransform, ...] = ()


def parse_tf_message(data: bytes) -> list[Transform]:
    values, found = Cdr(data), []
    for _ in range(values.integer()):
        values.time_ns()
        parent, child = values.text(), values.text()
        found.append(Transform(parent, child, values.doubles(3), values.doubles(4)))
    return found


def parse_frame_transform_json(data: bytes) -> list[Transform]:
    return [record_in(data, _FrameTransform).transform]


def parse_frame_transforms_json(data: bytes) -> list[Transform]:
    return [each.transform for each in record_in(data, _FrameTransforms).transforms]


def parse_frame_transform_protobuf(data: bytes) -> list[Transform]:
    return [_transform_of(Fields(data))]


def parse_frame_transforms_protobuf(data: bytes) -> list[Transform]:
    return [_transform_of(each) for each in Fields(data).messages(1)]


def _transform_of(fields: Fields) -> Transform:
    shift, turn = fields.message(4), fields.message(5)
    rotation = tuple(_number(turn, number) for number in (1, 2, 3, 4))
    translation = tuple(_number(shift, number) for number in (1, 2, 3))
    return Transform(fields.text(2), fields.text(3), translation, rotation if any(rotation) else (0.0, 0.0, 0.0, 1.0))


def _number(fields: Fields, number: int) -> float:
    found = fields.doubles(number)
    return found[-1] if found else 0.0


# By the schema's name and the messages' encoding, as MCAP has them.
_TRANSFORMS: dict[tuple[str, str], Callable[[bytes], list[Transform]]] = {
    ("tf2_msgs/msg/TFMessage", "cdr"): parse_tf_message,
    ("foxglove.FrameTransform", "json"): parse_frame_transform_json,
    ("foxglove.FrameTransform", "protobuf"): parse_frame_transform_protobuf,
    ("foxglove.FrameTransforms", "json"): parse_frame_transforms_json,
    ("foxglove.FrameTransforms", "protobuf"): parse_frame_transforms_protobuf,
}


def read_static_transforms(file: Path) -> dict[str, Transform]:
    """Reads what does not move in a log, by the child's frame.

    Of ROS what is on tf_static, of Foxglove what never changes. Raises UnusableMessage where a message cannot be read,
    and what reading the file raises.
    """
    told = [topic for topic in topics(file) if topic.kind in _TRANSFORMS and _may_be_static(topic)]
    found: dict[str, Transform] = {}
    moving: set[str] = set()
    for message in messages(file, {topic.name for topic in told}):
        if message.topic.kind not in _TRANSFORMS:
            continue
        with guard_untrusted(UnusableMessage, sanitize_text(message.topic.name)):
            for each in _TRANSFORMS[message.topic.kind](message.data):
                if each.child in moving:
                    continue
                before = found.setdefault(each.child, each)
                if len(found) > _MOST_FRAMES:
                    raise UnusableMessage(f"a log must have at most {_MOST_FRAMES} coordinate frames")
                if before is each or before == each:
                    continue
                if before.parent != each.parent or np.abs(before.matrix - each.matrix).max() > _SAME:
                    moving.add(each.child)
    return {child: each for child, each in found.items() if child not in moving}


def _may_be_static(topic: Topic) -> bool:
    return topic.encoding != "cdr" or topic.name.rpartition("/")[2] == _STATIC


def read_rig(file: Path, cameras: Mapping[str, str]) -> Rig:
    """The rig of a log's cameras, which `cameras` names: their image topics by camera id.

    Raises ValueError where the log does not tell where one of them stands, and what reading the file raises.
    """
    transforms = read_static_transforms(file)
    placed: dict[str, tuple[str, Array]] = {}
    for camera_id, topic in cameras.items():
        sensor = _find_sensor(file, topic)
        if sensor not in transforms:
            said = f"name the frame {sanitize_text(sensor, 100)!r}" if sensor else "name no frame"
            raise ValueError(
                f"{str(file)!r} does not tell where the camera {camera_id} stands: its images {said}, and "
                f"{_STATIC} has {_list_frames(transforms)}. Give the rig in a file"
            )
        placed[camera_id] = climb_tree(transforms, sensor)
    roots = {root for root, _ in placed.values()}
    if len(roots) > 1:
        raise ValueError(
            f"{str(file)!r} has cameras that move to each other, or whose {_STATIC} lacks a link: they hang on "
            f"{sanitize_text(', '.join(sorted(roots)))}. Give the rig in a file"
        )
    return Rig(tuple(RigCamera(camera_id, tuple(T.ravel().tolist())) for camera_id, (_, T) in placed.items()))


def _list_frames(transforms: Mapping[str, Transform]) -> str:
    return sanitize_text(", ".join(sorted(transforms)[:10])) or "no transforms"


def _find_sensor(file: Path, topic: str) -> str:
    first = next(messages(file, {topic}), None)
    return "" if first is None else read_picture(first).sensor


def climb_tree(transforms: Mapping[str, Transform], frame: str) -> tuple[str, Array]:
    """Finds the root above a coordinate frame, and T_root_frame (4, 4). Raises ValueError where links are a circle."""
    T, seen = np.eye(4), [frame]
    while frame in transforms:
        T = transforms[frame].matrix @ T
        frame = transforms[frame].parent
        if frame in seen:
            raise ValueError(f"the transforms of a log must be a tree; {sanitize_text(frame, 100)} is above itself")
        seen.append(frame)
    return frame, T
