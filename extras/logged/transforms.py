"""What a log tells of places: how its cameras stand to each other and on the robot, and how the robot moved."""

from __future__ import annotations

import logging
import math
from array import array
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from splatnode.capture.frame import GRAVITY_SIGMA_DEG, LARGEST_M, GivenPose, Gravity, make_given_pose
from splatnode.capture.process.config import record_in
from splatnode.capture.process.terminal import event
from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.capture.rig import Rig, RigCamera
from splatnode.extras.logged.mcap import Message, Topic, UnusableLog, messages, topics
from splatnode.extras.logged.messages import Cdr, Fields, UnusableMessage, read_picture

# Where the cameras of a log stand to each other: its static transforms, as a Rig.
#
# A camera is found by the coordinate frame that its images name, which is its optical frame: z forward, x right, y
# down (ROS' REP 103). The rig's frame is the root of the tree of static transforms, such as base_link. Sources:
# tf2_msgs/TFMessage and geometry_msgs of ROS 2; Foxglove's FrameTransform and FrameTransforms.

_STATIC = "tf_static"  # the last part of the topic on which ROS says what does not move
_NS = 10**9
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
    stamp_ns: int = field(default=0, compare=False)  # when it held; 0: not told

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


class _Time(msgspec.Struct, frozen=True):
    sec: int = 0
    nsec: int = 0


class _FrameTransform(msgspec.Struct, frozen=True):
    parent_frame_id: str
    child_frame_id: str
    translation: _Vector = _Vector()
    rotation: _Quaternion = _Quaternion(w=1.0)
    timestamp: _Time = _Time()

    @property
    def transform(self) -> Transform:
        shift, turn = (msgspec.structs.astuple(each) for each in (self.translation, self.rotation))
        stamp_ns = max(0, self.timestamp.sec * _NS + self.timestamp.nsec)
        return Transform(self.parent_frame_id, self.child_frame_id, shift, turn, stamp_ns)


class _FrameTransforms(msgspec.Struct, frozen=True):
    transforms: tuple[_FrameTransform, ...] = ()


def parse_tf_message(data: bytes) -> list[Transform]:
    values, found = Cdr(data), []
    for _ in range(values.integer()):
        stamp_ns, parent, child = values.time_ns(), values.text(), values.text()
        found.append(Transform(parent, child, values.doubles(3), values.doubles(4), stamp_ns))
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
    rotation = rotation if any(rotation) else (0.0, 0.0, 0.0, 1.0)
    stamp = fields.message(1)
    return Transform(fields.text(2), fields.text(3), translation, rotation, stamp.integer(1) * _NS + stamp.integer(2))


def _number(fields: Fields, number: int) -> float:
    found = fields.doubles(number)
    return found[-1] if found else 0.0


# By the schema's name and the messages' encoding, as MCAP has them.
TRANSFORMS: dict[tuple[str, str], Callable[[bytes], list[Transform]]] = {
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
    static_topics = [topic for topic in topics(file) if topic.kind in TRANSFORMS and may_be_static(topic)]
    found: dict[str, Transform] = {}
    moving: set[str] = set()
    for message in messages(file, {topic.name for topic in static_topics}):
        if message.topic.kind not in TRANSFORMS:
            continue
        with guard_untrusted(UnusableMessage, sanitize_text(message.topic.name)):
            for each in TRANSFORMS[message.topic.kind](message.data):
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


def may_be_static(topic: Topic) -> bool:
    """Whether a topic of transforms may tell what does not move."""
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


# What a log tells of its robot: where a camera stands on the base, where the base is by odometry, and where down is.
#
# Sources: tf2_msgs/TFMessage, nav_msgs/Odometry and sensor_msgs/Imu of ROS 2, and Foxglove's transforms; REP 103 and
# REP 105 for axes and the names of frames; REP 145: an accelerometer at rest measures what keeps it from falling.

log = logging.getLogger(__name__)

_MOST_ROWS = 2_000_000  # of transforms and accelerations of a log: 130 MB
_LONGEST_GAP_S = 1.0  # between two transforms: what lies farther apart is not interpolated
_BEYOND_S = 0.1  # before the first and after the last transform: it is taken to stand still so long
_WINDOW_S = 0.25  # before and after an image: of accelerations, whose mean is what gravity does
_LEAST_SAMPLES, _MOST_SAMPLES = 3, 500
_DEEPEST = 100  # coordinate frames above each other
_STANDARD_GRAVITY = 9.80665  # m/s²
_MOST_OFF = 1.5  # m/s² by which the mean acceleration may differ from it: else the robot speeds up, or brakes
_MOST_MEASURED = 1e4  # m/s² and rad/s


@dataclass(eq=False)
class _Link:
    """A coordinate frame against its parent, over time. Rows: seconds, x, y, z, qx, qy, qz, qw."""

    parent: str
    is_static: bool = False  # of ROS' tf_static
    may_be_static: bool = False  # it is where it never changes, as of Foxglove's transforms
    rows: array = field(default_factory=lambda: array("d"))

    @cached_property
    def table(self) -> Array:
        """(N, 8) in the order of time, each time once."""
        table = np.array(self.rows, np.float64).reshape(-1, 8)
        _, first = np.unique(table[:, 0], return_index=True)
        return table[first]

    @cached_property
    def stands_still(self) -> bool:
        table = self.table[:, 1:]
        return self.is_static or (self.may_be_static and bool(np.abs(table - table[0]).max() <= _SAME))

    def find_pose(self, at_s: float) -> Array | None:
        """T_parent_child (4, 4) at a time; None where nothing is told near it."""
        table = self.table
        if not len(table):
            return None
        if self.stands_still:
            return _make_matrix(table[-1])
        after = int(np.searchsorted(table[:, 0], at_s))
        if after in (0, len(table)):
            row = table[min(after, len(table) - 1)]
            return _make_matrix(row) if abs(row[0] - at_s) <= _BEYOND_S else None
        before, later = table[after - 1], table[after]
        if later[0] - before[0] > _LONGEST_GAP_S:
            nearest = min(before, later, key=lambda row: abs(row[0] - at_s))
            return _make_matrix(nearest) if abs(nearest[0] - at_s) <= _BEYOND_S else None
        part = (at_s - before[0]) / (later[0] - before[0])
        T = np.eye(4)
        T[:3, :3] = Slerp([0.0, 1.0], Rotation.from_quat([before[4:], later[4:]]))(part).as_matrix()
        T[:3, 3] = (1.0 - part) * before[1:4] + part * later[1:4]
        return T


def _make_matrix(row: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(row[4:]).as_matrix(), row[1:4]
    return T


@dataclass(frozen=True)
class _Inertia:
    """A measurement of an IMU, in its frame."""

    frame: str
    stamp_ns: int
    acceleration: tuple[float, ...]  # (3,) m/s²
    turn: tuple[float, ...]  # (3,) rad/s; zeros where it has no gyroscope


@dataclass(eq=False)
class RobotMotion:
    """All that a log tells of how its robot is built and moves. Times are nanoseconds of the messages' headers."""

    links: dict[str, _Link] = field(default_factory=dict)  # by the child's frame
    # Rows of seconds, acceleration in m/s² (3) and turn in rad/s (3), by the frame of the IMU
    inertia: dict[str, array] = field(default_factory=dict)

    @cached_property
    def _tables(self) -> dict[str, Array]:
        found = {name: np.array(rows, np.float64).reshape(-1, 7) for name, rows in self.inertia.items()}
        return {name: table[np.argsort(table[:, 0], kind="stable")] for name, table in found.items()}

    def find_pose(self, target: str, source: str, at_ns: int) -> Array | None:
        """T_target_source (4, 4) at a time; None where the log does not tell it.

        Links that are not needed, above what both hang on, may be missing.
        """
        above, below = self._list_ancestors(target), self._list_ancestors(source)
        common = next((frame for frame in below if frame in above), None)
        if common is None:
            return None
        T_common_source = self._compose(below[: below.index(common)], at_ns)
        T_common_target = self._compose(above[: above.index(common)], at_ns)
        if T_common_source is None or T_common_target is None:
            return None
        return np.linalg.inv(T_common_target) @ T_common_source

    def _compose(self, frames: Sequence[str], at_ns: int) -> Array | None:
        """The pose of the first of the frames in the parent of the last, each the child of the next."""
        T = np.eye(4)
        for frame in frames:
            step = self.links[frame].find_pose(at_ns / _NS)
            if step is None:
                return None
            T = step @ T
        return T

    def _list_ancestors(self, frame: str) -> list[str]:
        """The frame and those above it, no more than any robot has; as far as they are no circle."""
        found = [frame]
        while (link := self.links.get(found[-1])) is not None and link.parent not in found and len(found) < _DEEPEST:
            found.append(link.parent)
        return found

    def make_given_pose(self, odometry: str, sensor: str, at_ns: int) -> GivenPose | None:
        """The pose of a camera in the odometry's frame; None where the log does not tell it."""
        T = self.find_pose(odometry, sensor, at_ns) if odometry and sensor else None
        if T is None or np.abs(T).max() > LARGEST_M:
            return None
        return make_given_pose(T)

    def make_gravity(self, sensor: str, at_ns: int) -> Gravity | None:
        """Down in a camera's frame by the accelerometers; None where none is mounted in a way that is known, or rests.

        Its sigma grows with how far the acceleration is from that of gravity alone.
        """
        at_s = at_ns / _NS
        for frame, table in self._tables.items():
            T_sensor_imu = self.find_pose(sensor, frame, at_ns) if sensor else None
            low, high = np.searchsorted(table[:, 0], [at_s - _WINDOW_S, at_s + _WINDOW_S])
            if T_sensor_imu is None or high - low < _LEAST_SAMPLES:
                continue
            accelerations = _turn_back(table[low : high : -(-(high - low) // _MOST_SAMPLES)], at_s)
            mean = accelerations.mean(0)
            off = abs(float(np.linalg.norm(mean)) - _STANDARD_GRAVITY)
            if off > _MOST_OFF:
                continue
            x, y, z = (-T_sensor_imu[:3, :3] @ mean).tolist()
            shaken = float(np.sqrt(accelerations.var(0).sum() / (high - low))) / _STANDARD_GRAVITY
            unsure = math.hypot(GRAVITY_SIGMA_DEG, math.degrees(math.hypot(shaken, off / _STANDARD_GRAVITY)))
            return Gravity((x, y, z), unsure)
        return None

    def has_frame(self, frame: str) -> bool:
        """Whether a transform tells of a coordinate frame."""
        return frame in self.links or any(link.parent == frame for link in self.links.values())

    @property
    def says_nothing(self) -> bool:
        return not self.links and not self.inertia


def read_robot_motion(file: Path) -> RobotMotion:
    """Reads what a log tells of its robot, in one pass; nothing is read where it has no such topics.

    Where transforms and odometry tell the same frame, transforms count. A message that cannot be read is left out, and
    logged. Raises OSError; a damaged file is read as far as it goes.
    """
    found, by_odometry = RobotMotion(), RobotMotion()
    try:
        wanted = {topic.name for topic in topics(file) if topic.kind in _READERS}
    except UnusableLog:
        return found
    rows = unread = 0
    with suppress(UnusableLog):
        for message in messages(file, wanted) if wanted else ():
            read = _READERS.get(message.topic.kind)
            if read is None:
                continue
            try:
                with guard_untrusted(UnusableMessage, sanitize_text(message.topic.name)):
                    rows += read(message, by_odometry if message.topic.kind == _ODOMETRY else found)
            except UnusableMessage:
                unread += 1
            if rows > _MOST_ROWS or len(found.links) + len(by_odometry.links) > _MOST_FRAMES:
                event(log, logging.WARNING, "robot_motion_too_long", file=sanitize_text(str(file)), rows=rows)
                break
    if unread:
        event(log, logging.WARNING, "robot_motion_unreadable", file=sanitize_text(str(file)), messages=unread)
    return RobotMotion({**by_odometry.links, **found.links}, found.inertia)


def _add_transforms(message: Message, found: RobotMotion) -> int:
    transforms = TRANSFORMS[message.topic.kind](message.data)
    for each in transforms:
        _add_link(found, each, message)
    return len(transforms)


def _add_link(found: RobotMotion, each: Transform, message: Message) -> None:
    """Adds a transform. Raises UnusableMessage where it is no rigid motion."""
    quaternion = np.array(each.rotation)
    norm = float(np.linalg.norm(quaternion))
    numbers = (*each.translation, norm)
    if not (np.isfinite(numbers).all() and norm > _LEAST_NORM and max(map(abs, each.translation)) <= LARGEST_M):
        raise UnusableMessage(f"the transform of {sanitize_text(each.child, 100)} is no rigid motion")
    may, of_ros = may_be_static(message.topic), message.topic.encoding == "cdr"
    link = found.links.setdefault(each.child, _Link(each.parent, may and of_ros, may))
    if link.parent == each.parent:
        link.rows.extend(((each.stamp_ns or message.log_ns) / _NS, *each.translation, *(quaternion / norm)))


def _add_odometry(message: Message, found: RobotMotion) -> int:
    _add_link(found, parse_odometry(message.data), message)
    return 1


def _add_inertia(message: Message, found: RobotMotion) -> int:
    each = parse_imu(message.data)
    if each is None:
        return 0
    rows = found.inertia.setdefault(each.frame, array("d"))
    rows.extend(((each.stamp_ns or message.log_ns) / _NS, *each.acceleration, *each.turn))
    return 1


def _turn_back(table: Array, at_s: float) -> Array:
    """(N, 3) the accelerations of rows (N, 7) as they are in the IMU's frame at `at_s`: by what its gyroscope says."""
    turns = [Rotation.identity()]
    for row, following in pairwise(table):
        turns.append(turns[-1] * Rotation.from_rotvec(row[4:] * (following[0] - row[0])))
    before = max(0, int(np.searchsorted(table[:, 0], at_s, side="right")) - 1)
    at = turns[before] * Rotation.from_rotvec(table[before, 4:] * (at_s - table[before, 0]))
    return np.stack([(at.inv() * turn).apply(row[1:4]) for turn, row in zip(turns, table, strict=True)])


def parse_odometry(data: bytes) -> Transform:
    """nav_msgs/msg/Odometry: its pose is T_frame_child. Its covariance, which few set, is passed over."""
    values = Cdr(data)
    stamp_ns, parent, child = values.time_ns(), values.text(), values.text()
    return Transform(parent, child, values.doubles(3), values.doubles(4), stamp_ns)


def parse_imu(data: bytes) -> _Inertia | None:
    """sensor_msgs/msg/Imu: its acceleration and turn; None where it says that it has no accelerometer (REP 145)."""
    values = Cdr(data)
    stamp_ns, frame = values.time_ns(), values.text()
    _orientation, _covariance = values.doubles(4), values.doubles(9)
    turn, of_turn = values.doubles(3), values.doubles(9)
    acceleration, of_acceleration = values.doubles(3), values.doubles(9)
    if of_acceleration[0] == -1.0 or not _are_sane(acceleration):
        return None
    return _Inertia(frame, stamp_ns, acceleration, turn if of_turn[0] != -1.0 and _are_sane(turn) else (0.0, 0.0, 0.0))


def _are_sane(numbers: Sequence[float]) -> bool:
    return all(abs(number) <= _MOST_MEASURED for number in numbers)  # not so where one is no number


_ODOMETRY, _IMU = ("nav_msgs/msg/Odometry", "cdr"), ("sensor_msgs/msg/Imu", "cdr")
_READERS: Mapping[tuple[str, str], Callable[[Message, RobotMotion], int]] = {
    **dict.fromkeys(TRANSFORMS, _add_transforms),
    _ODOMETRY: _add_odometry,
    _IMU: _add_inertia,
}
