"""Which messages are pictures and calibrations, and what reads them."""

from __future__ import annotations

from collections.abc import Callable

from splatnode.capture.logged import foxglove, ros2
from splatnode.capture.logged.message import Calibration, Picture

# By the schema's name and the messages' encoding, as MCAP has them.
PICTURES: dict[tuple[str, str], Callable[[bytes], Picture]] = {
    ("foxglove.CompressedImage", "json"): foxglove.parse_compressed_json,
    ("foxglove.CompressedImage", "protobuf"): foxglove.parse_compressed_protobuf,
    ("foxglove.RawImage", "json"): foxglove.parse_raw_json,
    ("foxglove.RawImage", "protobuf"): foxglove.parse_raw_protobuf,
    ("sensor_msgs/msg/CompressedImage", "cdr"): ros2.parse_compressed_image,
    ("sensor_msgs/msg/Image", "cdr"): ros2.parse_raw_image,
}
CALIBRATIONS: dict[tuple[str, str], Callable[[bytes], Calibration]] = {
    ("foxglove.CameraCalibration", "json"): foxglove.parse_calibration_json,
    ("foxglove.CameraCalibration", "protobuf"): foxglove.parse_calibration_protobuf,
    ("sensor_msgs/msg/CameraInfo", "cdr"): ros2.parse_camera_info,
}
READ = (
    "foxglove.CompressedImage and RawImage in JSON or protobuf, and sensor_msgs/msg/CompressedImage and Image of ROS 2"
)
