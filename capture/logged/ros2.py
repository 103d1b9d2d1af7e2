"""sensor_msgs/CompressedImage, Image and CameraInfo of ROS 2. Source: common_interfaces' message definitions."""

from __future__ import annotations

from splatnode.capture.logged.cdr import Cdr
from splatnode.capture.logged.message import Calibration, Layout, Picture


def parse_compressed_image(data: bytes) -> Picture:
    values = Cdr(data)
    captured_ns, sensor = values.time_ns(), values.text()
    values.text()  # its format, which the data tells as well
    return Picture(sensor, captured_ns, values.bytes(), None)


def parse_raw_image(data: bytes) -> Picture:
    values = Cdr(data)
    captured_ns, sensor = values.time_ns(), values.text()
    height, width = values.integer(), values.integer()
    encoding, _big_endian, step = values.text(), values.byte(), values.integer()
    return Picture(sensor, captured_ns, values.bytes(), Layout(width, height, encoding, step))


def parse_camera_info(data: bytes) -> Calibration:
    values = Cdr(data)
    values.time_ns()
    sensor, height, width, model = values.text(), values.integer(), values.integer(), values.text()
    D, K, _R, P = values.doubles(), values.doubles(9), values.doubles(9), values.doubles(12)
    _across, _down = values.integer(), values.integer()  # binning: the image's size tells it
    x, y, window_height, window_width = (values.integer() for _ in range(4))
    return Calibration(sensor, width, height, model, D, K, P, (x, y, window_width, window_height))
