"""Messages of ROS 2 in CDR, written by hand after the definitions of tf2_msgs, nav_msgs and sensor_msgs."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from tests.support.mcap_files import Written, jpeg

STATIC, MOVING = "/tf_static", "/tf"
TransformRow = tuple[str, str, npt.NDArray[np.float64]]  # parent, child, T_parent_child


class CdrWriter:
    """Values one after the other, each aligned to its size; little-endian."""

    def __init__(self) -> None:
        self._data = b""

    def header(self, stamp_ns: int, frame: str) -> CdrWriter:
        """std_msgs/Header."""
        return self.numbers("iI", stamp_ns // 10**9, stamp_ns % 10**9).text(frame)

    def text(self, value: str) -> CdrWriter:
        return self.numbers("I", len(value) + 1).append(value.encode() + b"\0")

    def numbers(self, kinds: str, *values: float) -> CdrWriter:
        for kind, value in zip(kinds, values, strict=True):
            size = struct.calcsize(kind)
            self.append(bytes(-len(self._data) % size) + struct.pack(f"<{kind}", value))
        return self

    def doubles(self, values: Sequence[float]) -> CdrWriter:
        return self.numbers("d" * len(values), *values)

    def append(self, data: bytes) -> CdrWriter:
        self._data += data
        return self

    @property
    def message(self) -> bytes:
        return b"\0\1\0\0" + self._data


def transforms(topic: str, stamp_ns: int, *rows: TransformRow) -> Written:
    """tf2_msgs/msg/TFMessage."""
    writer = CdrWriter().numbers("I", len(rows))
    for parent, child, T in rows:
        writer.header(stamp_ns, parent).text(child).doubles([*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])
    return topic, "tf2_msgs/msg/TFMessage", "ros2msg", b"", writer.message


def odometry(stamp_ns: int, frame: str, child: str, T: npt.NDArray[np.float64], topic: str = "/odom") -> Written:
    """nav_msgs/msg/Odometry."""
    pose = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    writer = CdrWriter().header(stamp_ns, frame).text(child).doubles([*pose, *[0.0] * 36, *[0.0] * 42])
    return topic, "nav_msgs/msg/Odometry", "ros2msg", b"", writer.message


def imu(
    stamp_ns: int,
    frame: str,
    acceleration: Sequence[float],
    covariance: float = 0.0,
    turn: Sequence[float] = (0.0, 0.0, 0.0),
) -> Written:
    """sensor_msgs/msg/Imu whose orientation is not told."""
    numbers = [0.0, 0.0, 0.0, 0.0, -1.0, *[0.0] * 8, *turn, *[0.0] * 9, *acceleration, covariance, *[0.0] * 8]
    return "/imu", "sensor_msgs/msg/Imu", "ros2msg", b"", CdrWriter().header(stamp_ns, frame).doubles(numbers).message


def compressed(stamp_ns: int, frame: str, image: npt.NDArray[np.uint8], topic: str = "/camera/image") -> Written:
    """sensor_msgs/msg/CompressedImage."""
    data = jpeg(image)
    writer = CdrWriter().header(stamp_ns, frame).text("jpeg").numbers("I", len(data)).append(data)
    return f"{topic}/compressed", "sensor_msgs/msg/CompressedImage", "ros2msg", b"", writer.message
