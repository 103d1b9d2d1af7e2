"""The V4L2 camera against a driver made of Python: formats, stamps, losses, locks. The real driver is in tests/vm."""

from __future__ import annotations

import ctypes
import errno
import itertools
import time
from typing import Any

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import v4l2
from splatnode.capture.cameras.v4l2 import Config, Device, System, find, stream
from splatnode.capture.frame import CameraUnavailable, Clock, DroppedFrame, Frame, Intrinsics

IMAGE = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8), (0, 0), 3)
JPEG = cv2.imencode(".jpg", cv2.cvtColor(IMAGE, cv2.COLOR_RGB2BGR))[1].tobytes()
YUYV = cv2.cvtColor(IMAGE, cv2.COLOR_RGB2YUV_YUY2).tobytes()


class Driver:
    """What a webcam's driver answers. `events` are errnos by the number of the frame at which they come."""

    def __init__(self, formats=("MJPG", "YUYV"), controls=None, events=None, padding=0):
        self.formats = formats
        self.controls = dict(controls or {})
        self.events = events or {}
        self.padding = padding  # bytes at the end of each line
        self.pixels = ""
        self.queued: list[int] = []
        self.delivered = 0
        self.closed = False
        self.memory = [bytearray(64 * 48 * 4) for _ in range(4)]

    def system(self):
        return System(
            open=lambda path, flags: self._open(path),
            close=lambda fd: setattr(self, "closed", True),
            ioctl=self._ioctl,
            map=lambda fd, length, offset: memoryview(self.memory[offset >> 12]),
            readable=lambda fd, timeout_s: self.events.get(self.delivered) != "silence",
        )

    def _open(self, path):
        if path != "/dev/video0":
            raise OSError(errno.ENOENT, "No such file or directory")
        self.closed = False
        return 7

    def _ioctl(self, fd, request, argument):
        assert fd == 7 and not self.closed
        name = next(name for name in dir(v4l2) if getattr(v4l2, name) == request)
        getattr(self, f"_{name.lower()}")(argument)

    def _querycap(self, it):
        it.card, it.bus_info = b"Fake Webcam", b"usb-1"
        it.capabilities = v4l2.HAS_DEVICE_CAPS | v4l2.CAN_CAPTURE
        it.device_caps = v4l2.CAN_CAPTURE | v4l2.CAN_STREAM

    def _enum_fmt(self, it):
        if it.index >= len(self.formats):
            raise OSError(errno.EINVAL, "Invalid argument")
        it.pixelformat = v4l2.fourcc(self.formats[it.index])

    def _s_fmt(self, it):
        pix = it.fmt.pix
        self.pixels = v4l2.fourcc_name(pix.pixelformat)
        if self.pixels not in self.formats:
            self.pixels = self.formats[0]
        pix.pixelformat, pix.width, pix.height = v4l2.fourcc(self.pixels), 64, 48
        pix.bytesperline = 128 + self.padding if self.pixels == "YUYV" else 0

    def _s_parm(self, it):
        raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")

    def _reqbufs(self, it):
        if self.events.get("busy"):
            raise OSError(errno.EBUSY, "Device or resource busy")
        it.count = 2

    def _querybuf(self, it):
        it.length, it.m.offset = len(self.memory[0]), it.index << 12

    def _qbuf(self, it):
        self.queued.append(it.index)

    def _streamon(self, it):
        assert isinstance(it, ctypes.c_int) and it.value == v4l2.CAPTURE

    _streamoff = _streamon

    def _dqbuf(self, it):
        event = self.events.get(self.delivered)
        self.delivered += 1
        if isinstance(event, int):
            raise OSError(event, "as asked")
        it.index = self.queued.pop(0)
        data = JPEG if self.pixels == "MJPG" else self._padded()
        if event == "short":
            data = data[: len(data) // 2]
        self.memory[it.index][: len(data)] = data
        it.bytesused, it.sequence = len(data), self.delivered
        it.timestamp.seconds, it.timestamp.microseconds = 100, 1000 * self.delivered
        it.flags = v4l2.TIMESTAMP_MONOTONIC | (v4l2.BUFFER_ERROR if event == "error" else 0)

    def _padded(self):
        lines = np.frombuffer(YUYV, np.uint8).reshape(48, 128)
        return np.pad(lines, ((0, 0), (0, self.padding))).tobytes()

    def _queryctrl(self, it):
        if it.id not in self.controls:
            raise OSError(errno.EINVAL, "Invalid argument")
        it.name = b"control"

    def _g_ctrl(self, it):
        it.value = self.controls[it.id]

    def _s_ctrl(self, it):
        if self.controls[it.id] == "stubborn":
            raise OSError(errno.EINVAL, "Invalid argument")
        self.controls[it.id] = it.value


def frames(driver, count, **config) -> list[Any]:
    config = {"device": "/dev/video0", "warmup_s": 0.0, "lock_exposure": False, **config}
    return list(itertools.islice(stream(Config(**config), driver.system()), count))


@pytest.fixture(autouse=True)
def no_real_cameras(monkeypatch):
    monkeypatch.setattr(v4l2, "find", lambda system=None: [])


def test_the_structs_are_as_large_as_the_kernels():
    sizes = (
        v4l2.Capability,
        v4l2.FormatStruct,
        v4l2.BufferRequest,
        v4l2.Buffer,
        v4l2.StreamParameters,
    )
    assert [ctypes.sizeof(size) for size in sizes] == [104, 208, 20, 88, 204]
    assert (v4l2.QUERYCAP, v4l2.S_FMT, v4l2.DQBUF) == (0x80685600, 0xC0D05605, 0xC0585611)
    assert (v4l2.STREAMON, v4l2.S_PARM, v4l2.QUERYCTRL) == (0x40045612, 0xC0CC5616, 0xC0445624)


def test_jpeg_frames_keep_their_bytes():
    first, second = frames(Driver(), 2)
    assert isinstance(first, Frame) and first.encoded == JPEG
    assert np.abs(first.image.astype(int) - IMAGE).mean() < 5
    assert (first.frame_id, first.name, first.stamp_ns) == (0, "100.001000", 100_001_000_000)
    assert (second.frame_id, second.name, second.stamp_ns) == (1, "100.002000", 100_002_000_000)


def test_the_drivers_stamps_are_told_by_the_wall_clock():
    (frame,) = frames(Driver(), 1)
    ahead_ns = time.time_ns() - time.monotonic_ns()
    assert frame.captured_at.clock is Clock.UTC
    assert abs(frame.captured_at.ns - frame.stamp_ns - ahead_ns) < 100_000_000


@pytest.mark.parametrize("padding", [0, 16])
def test_raw_frames_are_decoded_line_by_line(padding):
    (frame,) = frames(Driver(padding=padding), 1, fourcc="YUYV")
    assert np.abs(frame.image.astype(int) - IMAGE).mean() < 5 and frame.encoded is None


def test_a_driver_that_has_only_the_other_format_is_used():
    assert frames(Driver(formats=("YUYV",)), 1)[0].image.shape == (48, 64, 3)
    with pytest.raises(CameraUnavailable, match="gives NV12, and MJPG or YUYV is needed; it has: NV12"):
        frames(Driver(formats=("NV12",)), 1)


def test_intrinsics_follow_the_size():
    lens = Intrinsics(128, 96, 100.0, 100.0, 64.0, 48.0, "calibration", (0.1,))
    assert frames(Driver(), 1, intrinsics=lens)[0].intrinsics == lens.resized(64, 48)


def test_a_lens_of_another_aspect_ratio_ends_the_camera_before_a_frame():
    driver = Driver()
    with pytest.raises(ValueError, match="aspect ratio, got those of 128 x 72 for 64 x 48.*or photographs of its"):
        frames(driver, 1, intrinsics=Intrinsics(128, 72, 100.0, 100.0, 64.0, 36.0, "calibration"))
    assert driver.delivered == 0 and driver.closed


@pytest.mark.parametrize(("event", "reason"), [("error", "driver says"), ("short", "truncated")])
@pytest.mark.parametrize("pixels", ["MJPG", "YUYV"])
def test_damaged_frames_are_left_out(event, reason, pixels):
    before, damaged, after = frames(Driver(events={1: event}), 3, fourcc=pixels)
    assert isinstance(damaged, DroppedFrame) and reason in damaged.reason
    assert (before.frame_id, after.frame_id) == (0, 1)


@pytest.mark.parametrize(
    ("driver", "config", "message"),
    [
        (Driver(events={2: errno.ENODEV}), {}, "was unplugged"),
        (Driver(events={2: "silence"}), {"frame_timeout_s": 0.5}, "gave no frame for 0.5 s"),
        (Driver(events={"busy": True}), {}, "used by another program"),
        (Driver(), {"device": "/dev/video9"}, "no camera at /dev/video9; none is connected"),
        (Driver(), {"device": ""}, "must say which camera; none is connected"),
    ],
)
def test_a_lost_camera_says_why(driver, config, message):
    with pytest.raises(CameraUnavailable, match=message):
        frames(driver, 10, **config)
    assert driver.closed or not driver.queued


def test_exposure_and_white_balance_are_held_at_what_the_camera_chose():
    controls = {
        v4l2.AUTO_EXPOSURE: 1,
        v4l2.EXPOSURE: 156,
        v4l2.AUTO_WHITE_BALANCE: 0,
        v4l2.EXPOSURE_PRIORITY: 1,
    }
    driver = Driver(controls=controls)
    frames(driver, 1, lock_exposure=True)
    assert driver.controls == {
        v4l2.AUTO_EXPOSURE: v4l2.EXPOSURE_MANUAL,
        v4l2.EXPOSURE: 156,
        v4l2.AUTO_WHITE_BALANCE: 0,
        v4l2.EXPOSURE_PRIORITY: 0,
    }
    frames(driver, 1, lock_exposure=True, exposure_us=5000)
    assert driver.controls[v4l2.EXPOSURE] == 50


def test_what_cannot_be_held_is_told():
    controls = {v4l2.AUTO_EXPOSURE: "stubborn", v4l2.AUTO_WHITE_BALANCE: 1}
    with Device("/dev/video0", Driver(controls=controls).system()) as device:
        assert v4l2.hold(device) == {"exposure": False, "gain": None, "white_balance": True, "focus": None}


def test_closing_the_stream_closes_the_device():
    driver = Driver()
    items: Any = stream(Config(device="/dev/video0", lock_exposure=False), driver.system())
    next(items)
    items.close()
    assert driver.closed


def test_finding_needs_no_camera(monkeypatch):
    monkeypatch.undo()
    assert isinstance(find(), list)
