"""One capture device: its format, its buffers, its controls. Every call that fails raises OSError with the errno.

Frames come with the driver's own stamp (monotonic clock, at exposure) and sequence number, which libraries above V4L2
do not give; a device that is unplugged answers ENODEV at once, where OpenCV reports an open camera without frames.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import mmap
import os
import select
import time
from collections.abc import Callable
from dataclasses import dataclass

from splatnode.capture.video4linux import layout as v4l2

BUFFERS = 4  # frames that the driver may fill while nobody reads


def _readable(fd: int, timeout_s: float) -> bool:
    """Whether a frame, or the news that the device is gone, can be read within the time."""
    poller = select.poll()
    poller.register(fd, select.POLLIN)
    return bool(poller.poll(timeout_s * 1000))


@dataclass(frozen=True)
class System:
    """The system calls that a device makes; tests give a driver of their own."""

    open: Callable[[str, int], int] = os.open
    close: Callable[[int], None] = os.close
    ioctl: Callable[[int, int, ctypes.Structure | ctypes.c_int], object] = fcntl.ioctl
    map: Callable[[int, int, int], memoryview] = lambda fd, length, offset: memoryview(
        mmap.mmap(fd, length, offset=offset)
    )
    readable: Callable[[int, float], bool] = _readable


@dataclass(frozen=True)
class Format:
    pixels: str  # fourcc
    width: int
    height: int
    bytes_per_line: int


@dataclass(frozen=True)
class RawFrame:
    data: bytes
    sequence: int  # the driver's; gaps are frames that were lost before they came here
    stamp_ns: int  # CLOCK_MONOTONIC
    damaged: bool


@dataclass(frozen=True)
class ControlRange:
    name: str
    minimum: int
    maximum: int
    default: int


class Device:
    """An open device. Close it, or use it as a context manager."""

    def __init__(self, path: str, system: System | None = None) -> None:
        """Raises OSError; ENOTTY or ENODEV where `path` is no camera."""
        self.path = path
        self._system = system or System()
        self._buffers: list[memoryview] = []
        self._fd = self._system.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            capability = v4l2.Capability()
            self._ioctl(v4l2.QUERYCAP, capability)
            caps = capability.capabilities
            self._caps = capability.device_caps if caps & v4l2.HAS_DEVICE_CAPS else caps
            self.card = capability.card.decode(errors="replace")
            self.bus = capability.bus_info.decode(errors="replace")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Device:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_camera(self) -> bool:
        """Not a metadata node, an output, or a tuner."""
        wanted = v4l2.CAN_CAPTURE | v4l2.CAN_STREAM
        return self._caps & wanted == wanted

    def close(self) -> None:
        if self._fd < 0:
            return
        if self._buffers:
            with contextlib.suppress(OSError):  # unplugged
                self._ioctl(v4l2.STREAMOFF, ctypes.c_int(v4l2.CAPTURE))
        self._buffers.clear()
        self._system.close(self._fd)
        self._fd = -1

    def pixel_formats(self) -> tuple[str, ...]:
        """Fourccs in the driver's order."""
        found = []
        description = v4l2.FormatDescription(type=v4l2.CAPTURE)
        while self._exists(v4l2.ENUM_FMT, description):
            found.append(v4l2.fourcc_name(description.pixelformat))
            description = v4l2.FormatDescription(index=len(found), type=v4l2.CAPTURE)
        return tuple(found)

    def set_format(self, pixels: str, width: int, height: int) -> Format:
        """The format that the driver chose, which may be another one."""
        wish = v4l2.Format(type=v4l2.CAPTURE)
        wish.fmt.pix.width, wish.fmt.pix.height = width, height
        wish.fmt.pix.pixelformat, wish.fmt.pix.field = v4l2.fourcc(pixels), v4l2.FIELD_NONE
        self._ioctl(v4l2.S_FMT, wish)
        got = wish.fmt.pix
        return Format(v4l2.fourcc_name(got.pixelformat), got.width, got.height, got.bytesperline)

    def set_rate(self, frames_per_second: float) -> float | None:
        """The rate that the driver chose; None where the device's rate cannot be set."""
        wish = v4l2.StreamParameters(type=v4l2.CAPTURE)
        wish.parm.capture.numerator, wish.parm.capture.denominator = 1000, round(1000 * frames_per_second)
        if not self._exists(v4l2.S_PARM, wish):
            return None
        got = wish.parm.capture
        return got.denominator / got.numerator if got.numerator else None

    def start(self) -> None:
        request = v4l2.BufferRequest(count=BUFFERS, type=v4l2.CAPTURE, memory=v4l2.MMAP)
        self._ioctl(v4l2.REQBUFS, request)
        for index in range(request.count):
            buffer = v4l2.Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP)
            self._ioctl(v4l2.QUERYBUF, buffer)
            self._buffers.append(self._system.map(self._fd, buffer.length, buffer.m.offset))
            self._ioctl(v4l2.QBUF, buffer)
        self._ioctl(v4l2.STREAMON, ctypes.c_int(v4l2.CAPTURE))

    def read(self, timeout_s: float) -> RawFrame | None:
        """The next frame; None where none comes in time."""
        if not self._system.readable(self._fd, timeout_s):
            return None
        buffer = v4l2.Buffer(type=v4l2.CAPTURE, memory=v4l2.MMAP)
        if not self._exists(v4l2.DQBUF, buffer, nothing=errno.EAGAIN):
            return None
        data = bytes(self._buffers[buffer.index][: buffer.bytesused])
        frame = RawFrame(data, buffer.sequence, _stamp_ns(buffer), bool(buffer.flags & v4l2.BUFFER_ERROR))
        self._ioctl(v4l2.QBUF, buffer)
        return frame

    def control_range(self, control: int) -> ControlRange | None:
        """None where the device has no such control."""
        description = v4l2.ControlDescription(id=control)
        if not self._exists(v4l2.QUERYCTRL, description):
            return None
        name = description.name.decode(errors="replace")
        return ControlRange(name, description.minimum, description.maximum, description.default_value)

    def get_control(self, control: int) -> int:
        argument = v4l2.Control(id=control)
        self._ioctl(v4l2.G_CTRL, argument)
        return argument.value

    def set_control(self, control: int, value: int) -> int:
        """The value that the device reports afterwards, which may be another one."""
        self._ioctl(v4l2.S_CTRL, v4l2.Control(id=control, value=value))
        return self.get_control(control)

    def _ioctl(self, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        while True:
            try:
                self._system.ioctl(self._fd, request, argument)
                return
            except InterruptedError:
                continue

    def _exists(self, request: int, argument: ctypes.Structure, nothing: int = errno.EINVAL) -> bool:
        """Whether the request succeeds; False where its errno is `nothing`, or says that the request is unknown."""
        try:
            self._ioctl(request, argument)
        except OSError as error:
            if error.errno not in (nothing, errno.ENOTTY):
                raise
            return False
        return True


def _stamp_ns(buffer: v4l2.Buffer) -> int:
    """The driver's stamp, or now where it is of another clock."""
    if buffer.flags & v4l2.TIMESTAMP_MASK != v4l2.TIMESTAMP_MONOTONIC:
        return time.monotonic_ns()
    return buffer.timestamp.seconds * 10**9 + buffer.timestamp.microseconds * 1000
