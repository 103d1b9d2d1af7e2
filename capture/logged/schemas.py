"""Which messages are pictures and calibrations, and what reads them."""

from __future__ import annotations

from collections.abc import Callable

from splatnode.capture.logged import foxglove, ros2
from splatnode.capture.logged.message import Calibration, Picture

# By the schema's name and the messages' encoding, as MCAP has them.
PICTURES: dict[tuple[str, str], Callable[[bytes], Picture]] = {
    ("foxglove.CompressedImage", "json"): foxglove.compressed_of_json,
    ("foxglove.CompressedImage", "protobuf"): foxglove.compressed_of_protobuf,
    ("foxglove.RawImage", "json"): foxglove.raw_of_json,
    ("foxglove.RawImage", "protobuf"): foxglove.raw_of_protobuf,
    ("sensor_msgs/msg/CompressedImage", "cdr"): ros2.compressed,
    ("sensor_msgs/msg/Image", "cdr"): ros2.raw,
}
CALIBRATIONS: dict[tuple[str, str], Callable[[bytes], Calibration]] = {
    ("foxglove.CameraCalibration", "json"): foxglove.calibration_of_json,
    ("foxglove.CameraCalibration", "protobuf"): foxglove.calibration_of_protobuf,
    ("sensor_msgs/msg/CameraInfo", "cdr"): ros2.calibration,
}
READ = (
    "foxglove.CompressedImage and RawImage in JSON or protobuf, and sensor_msgs/msg/CompressedImage and Image of ROS 2"
)
