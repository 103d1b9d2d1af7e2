"""A UVC webcam, or any other Video4Linux2 camera.

A device has its format, its buffers and its controls; every call that fails raises OSError with the errno. Frames come
with the driver's own stamp (monotonic clock, at exposure) and sequence number, which libraries above V4L2 do not give;
a device that is unplugged answers ENODEV at once, where OpenCV reports an open camera without frames.
"""

from __future__ import annotations

import contextlib
import ctypes
import ctypes as c
import errno
import fcntl
import logging
import mmap
import os
import select
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import (
    CameraUnavailable,
    DroppedFrame,
    Frame,
    FramesPerSecond,
    Intrinsics,
    make_frame,
    wall_clock,
)
from splatnode.capture.image_file import UnusableImage, decode_image
from splatnode.capture.lenses import check_fits
from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.terminal import event

# The kernel's structs and request numbers, from linux/videodev2.h; ctypes lays them out as the C compiler does.

CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
MMAP = 1  # V4L2_MEMORY_MMAP
FIELD_NONE = 1

CAN_CAPTURE = 0x0000_0001  # V4L2_CAP_*
CAN_STREAM = 0x0400_0000
HAS_DEVICE_CAPS = 0x8000_0000

BUFFER_ERROR = 0x0040  # V4L2_BUF_FLAG_*
TIMESTAMP_MASK, TIMESTAMP_MONOTONIC = 0xE000, 0x2000


class Capability(c.Structure):
    _fields_ = (
        ("driver", c.c_char * 16),
        ("card", c.c_char * 32),
        ("bus_info", c.c_char * 32),
        ("version", c.c_uint32),
        ("capabilities", c.c_uint32),
        ("device_caps", c.c_uint32),
        ("reserved", c.c_uint32 * 3),
    )


class _PixelFormat(c.Structure):
    _fields_ = (
        ("width", c.c_uint32),
        ("height", c.c_uint32),
        ("pixelformat", c.c_uint32),
        ("field", c.c_uint32),
        ("bytesperline", c.c_uint32),
        ("sizeimage", c.c_uint32),
        ("rest", c.c_uint32 * 6),
    )


class _FormatUnion(c.Union):
    _fields_ = (("pix", _PixelFormat), ("raw", c.c_uint8 * 200), ("aligned", c.c_void_p))


class FormatStruct(c.Structure):
    _fields_ = (("type", c.c_uint32), ("fmt", _FormatUnion))


class FormatDescription(c.Structure):
    _fields_ = (
        ("index", c.c_uint32),
        ("type", c.c_uint32),
        ("flags", c.c_uint32),
        ("description", c.c_char * 32),
        ("pixelformat", c.c_uint32),
        ("mbus_code", c.c_uint32),
        ("reserved", c.c_uint32 * 3),
    )


class BufferRequest(c.Structure):
    _fields_ = (
        ("count", c.c_uint32),
        ("type", c.c_uint32),
        ("memory", c.c_uint32),
        ("capabilities", c.c_uint32),
        ("flags", c.c_uint8),
        ("reserved", c.c_uint8 * 3),
    )


class _Time(c.Structure):
    _fields_ = (("seconds", c.c_long), ("microseconds", c.c_long))


class _Memory(c.Union):
    _fields_ = (("offset", c.c_uint32), ("userptr", c.c_ulong), ("planes", c.c_void_p), ("fd", c.c_int32))


class Buffer(c.Structure):
    _fields_ = (
        ("index", c.c_uint32),
        ("type", c.c_uint32),
        ("bytesused", c.c_uint32),
        ("flags", c.c_uint32),
        ("field", c.c_uint32),
        ("timestamp", _Time),
        ("timecode", c.c_uint32 * 4),
        ("sequence", c.c_uint32),
        ("memory", c.c_uint32),
        ("m", _Memory),
        ("length", c.c_uint32),
        ("reserved2", c.c_uint32),
        ("request_fd", c.c_int32),
    )


class _CaptureParameters(c.Structure):
    _fields_ = (
        ("capability", c.c_uint32),
        ("capturemode", c.c_uint32),
        ("numerator", c.c_uint32),  # of the seconds a frame
        ("denominator", c.c_uint32),
        ("rest", c.c_uint32 * 6),
    )


class _ParametersUnion(c.Union):
    _fields_ = (("capture", _CaptureParameters), ("raw", c.c_uint8 * 200))


class StreamParameters(c.Structure):
    _fields_ = (("type", c.c_uint32), ("parm", _ParametersUnion))


class ControlDescription(c.Structure):
    _fields_ = (
        ("id", c.c_uint32),
        ("type", c.c_uint32),
        ("name", c.c_char * 32),
        ("minimum", c.c_int32),
        ("maximum", c.c_int32),
        ("step", c.c_int32),
        ("default_value", c.c_int32),
        ("flags", c.c_uint32),
        ("reserved", c.c_uint32 * 2),
    )


class Control(c.Structure):
    _fields_ = (("id", c.c_uint32), ("value", c.c_int32))


def _request(direction: int, number: int, argument: type) -> int:
    """The number of an ioctl: direction, size of its argument, 'V', its own number (asm-generic/ioctl.h)."""
    return direction << 30 | c.sizeof(argument) << 16 | ord("V") << 8 | number


_WRITE, _READ = 1, 2
QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_READ | _WRITE, 2, FormatDescription)
S_FMT = _request(_READ | _WRITE, 5, FormatStruct)
REQBUFS = _request(_READ | _WRITE, 8, BufferRequest)
QUERYBUF = _request(_READ | _WRITE, 9, Buffer)
QBUF = _request(_READ | _WRITE, 15, Buffer)
DQBUF = _request(_READ | _WRITE, 17, Buffer)
STREAMON = _request(_WRITE, 18, c.c_int)
STREAMOFF = _request(_WRITE, 19, c.c_int)
S_PARM = _request(_READ | _WRITE, 22, StreamParameters)
G_CTRL = _request(_READ | _WRITE, 27, Control)
S_CTRL = _request(_READ | _WRITE, 28, Control)
QUERYCTRL = _request(_READ | _WRITE, 36, ControlDescription)


def fourcc(text: str) -> int:
    return int.from_bytes(text.encode("ascii"), "little")


def fourcc_name(number: int) -> str:
    return number.to_bytes(4, "little").decode("ascii", "replace")


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
            capability = Capability()
            self._ioctl(QUERYCAP, capability)
            caps = capability.capabilities
            self._caps = capability.device_caps if caps & HAS_DEVICE_CAPS else caps
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
        wanted = CAN_CAPTURE | CAN_STREAM
        return self._caps & wanted == wanted

    def close(self) -> None:
        if self._fd < 0:
            return
        if self._buffers:
            with contextlib.suppress(OSError):  # unplugged
                self._ioctl(STREAMOFF, ctypes.c_int(CAPTURE))
        self._buffers.clear()
        self._system.close(self._fd)
        self._fd = -1

    def pixel_formats(self) -> tuple[str, ...]:
        """Fourccs in the driver's order."""
        found = []
        description = FormatDescription(type=CAPTURE)
        while self._exists(ENUM_FMT, description):
            found.append(fourcc_name(description.pixelformat))
            description = FormatDescription(index=len(found), type=CAPTURE)
        return tuple(found)

    def set_format(self, pixels: str, width: int, height: int) -> Format:
        """The format that the driver chose, which may be another one."""
        wish = FormatStruct(type=CAPTURE)
        wish.fmt.pix.width, wish.fmt.pix.height = width, height
        wish.fmt.pix.pixelformat, wish.fmt.pix.field = fourcc(pixels), FIELD_NONE
        self._ioctl(S_FMT, wish)
        got = wish.fmt.pix
        return Format(fourcc_name(got.pixelformat), got.width, got.height, got.bytesperline)

    def set_rate(self, frames_per_second: float) -> float | None:
        """The rate that the driver chose; None where the device's rate cannot be set."""
        wish = StreamParameters(type=CAPTURE)
        wish.parm.capture.numerator, wish.parm.capture.denominator = 1000, round(1000 * frames_per_second)
        if not self._exists(S_PARM, wish):
            return None
        got = wish.parm.capture
        return got.denominator / got.numerator if got.numerator else None

    def start(self) -> None:
        request = BufferRequest(count=BUFFERS, type=CAPTURE, memory=MMAP)
        self._ioctl(REQBUFS, request)
        for index in range(request.count):
            buffer = Buffer(index=index, type=CAPTURE, memory=MMAP)
            self._ioctl(QUERYBUF, buffer)
            self._buffers.append(self._system.map(self._fd, buffer.length, buffer.m.offset))
            self._ioctl(QBUF, buffer)
        self._ioctl(STREAMON, ctypes.c_int(CAPTURE))

    def read(self, timeout_s: float) -> RawFrame | None:
        """The next frame; None where none comes in time."""
        if not self._system.readable(self._fd, timeout_s):
            return None
        buffer = Buffer(type=CAPTURE, memory=MMAP)
        if not self._exists(DQBUF, buffer, nothing=errno.EAGAIN):
            return None
        data = bytes(self._buffers[buffer.index][: buffer.bytesused])
        frame = RawFrame(data, buffer.sequence, _stamp_ns(buffer), bool(buffer.flags & BUFFER_ERROR))
        self._ioctl(QBUF, buffer)
        return frame

    def control_range(self, control: int) -> ControlRange | None:
        """None where the device has no such control."""
        description = ControlDescription(id=control)
        if not self._exists(QUERYCTRL, description):
            return None
        name = description.name.decode(errors="replace")
        return ControlRange(name, description.minimum, description.maximum, description.default_value)

    def get_control(self, control: int) -> int:
        argument = Control(id=control)
        self._ioctl(G_CTRL, argument)
        return argument.value

    def set_control(self, control: int, value: int) -> int:
        """The value that the device reports afterwards, which may be another one."""
        self._ioctl(S_CTRL, Control(id=control, value=value))
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


def _stamp_ns(buffer: Buffer) -> int:
    """The driver's stamp, or now where it is of another clock."""
    if buffer.flags & TIMESTAMP_MASK != TIMESTAMP_MONOTONIC:
        return time.monotonic_ns()
    return buffer.timestamp.seconds * 10**9 + buffer.timestamp.microseconds * 1000


# Holding exposure, white balance and focus still: a scene whose colours change between frames cannot be modelled.

log = logging.getLogger(__name__)

AUTO_WHITE_BALANCE, GAIN, AUTO_GAIN = 0x98090C, 0x980913, 0x980912  # V4L2_CID_*
AUTO_EXPOSURE, EXPOSURE, EXPOSURE_PRIORITY = 0x9A0901, 0x9A0902, 0x9A0903
FOCUS, AUTO_FOCUS = 0x9A090A, 0x9A090C
EXPOSURE_MANUAL, EXPOSURE_BY_APERTURE = 1, 3  # most webcams call their automatic "aperture priority"
_UNIT_US = 100  # of EXPOSURE


@dataclass(frozen=True)
class Lock:
    """An automatic control, the value that turns it off, and the value that it would go on choosing."""

    name: str
    automatic: int
    off: int
    value: int | None = None


LOCKS = (
    Lock("exposure", AUTO_EXPOSURE, EXPOSURE_MANUAL, EXPOSURE),
    Lock("gain", AUTO_GAIN, 0, GAIN),
    Lock("white_balance", AUTO_WHITE_BALANCE, 0),
    Lock("focus", AUTO_FOCUS, 0, FOCUS),
)


def run_free(device: Device) -> None:
    """Lets the camera choose, at a constant frame rate."""
    for control, wish in (
        (AUTO_EXPOSURE, EXPOSURE_BY_APERTURE),
        (EXPOSURE_PRIORITY, 0),
        (AUTO_GAIN, 1),
        (AUTO_WHITE_BALANCE, 1),
        (AUTO_FOCUS, 1),
    ):
        _set(device, control, wish)


def hold(device: Device, exposure_us: int | None = None) -> dict[str, bool | None]:
    """Holds what the camera has chosen, or `exposure_us`: whether each automatic is off; None where it has none."""
    held = {}
    for lock in LOCKS:
        if device.control_range(lock.automatic) is None:
            held[lock.name] = None
            continue
        chosen = _get(device, lock.value) if lock.value is not None else None
        held[lock.name] = _set(device, lock.automatic, lock.off)
        if held[lock.name] and chosen is not None and lock.value is not None:
            _set(device, lock.value, chosen)
    if exposure_us is not None:
        held["exposure"] = bool(held["exposure"]) and _set(device, EXPOSURE, max(1, round(exposure_us / _UNIT_US)))
    event(log, logging.INFO, "locked", **held)
    return held


def _get(device: Device, control: int) -> int | None:
    return device.get_control(control) if device.control_range(control) is not None else None


def _set(device: Device, control: int, value: int) -> bool:
    """Whether the camera reads back what was set; one that refuses is no error."""
    if device.control_range(control) is None:
        return False
    try:
        return device.set_control(control, value) == value
    except OSError as error:
        if error.errno == errno.ENODEV:
            raise
        return False


LIVE = True

_BY_ID, _BY_PATH = Path("/dev/v4l/by-id"), Path("/dev/v4l/by-path")


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    device: str = (
        ""  # as `splatnode list-cameras` prints it: a name that stays when ports and numbers change; "": the only one
    )
    width: Annotated[int, msgspec.Meta(ge=1)] = 1280  # of an image, pixels
    height: Annotated[int, msgspec.Meta(ge=1)] = 720  # of an image, pixels
    fps: FramesPerSecond = 30.0  # that the camera is asked for
    # Format that the camera sends; USB 2 carries no more than 10 frames of 1280 x 720 a second as YUYV
    fourcc: Literal["MJPG", "YUYV"] = "MJPG"
    lock_exposure: bool = True  # hold exposure, gain, white balance and focus, once the camera has chosen them
    # After the start, in which the camera chooses them; these frames are not given
    warmup_s: Annotated[float, msgspec.Meta(ge=0)] = 1.5
    # Instead of what the camera chooses; None: it chooses
    exposure_us: Annotated[int, msgspec.Meta(ge=1)] | None = None
    frame_timeout_s: Annotated[float, msgspec.Meta(gt=0)] = 3.0  # so long without a frame, the camera counts as lost
    intrinsics: Intrinsics | None = None  # the lens, of a calibration at the same aspect ratio


def stream(config: Config, system: System | None = None) -> Iterator[Frame | DroppedFrame]:
    """Frames as they come, stamped by the driver at exposure.

    Raises CameraUnavailable, at first and when unplugged; ValueError where the lens cannot be of the camera's images.
    """
    path = config.device or _only_camera(system)
    try:
        with Device(path, system) as device:
            yield from _frames(device, config)
    except OSError as error:
        raise CameraUnavailable(_explain(error, path, system)) from error


def find(system: System | None = None) -> list[dict[str, str]]:
    """The cameras that are connected: `device` for the configuration, `description` for the reader."""
    found = []
    for number in sorted(Path("/sys/class/video4linux").glob("video*"), key=lambda path: int(path.name[5:] or 0)):
        try:
            with Device(f"/dev/{number.name}", system) as device:
                if device.is_camera:
                    text = f"{device.card} ({device.bus}): {', '.join(device.pixel_formats())}"
                    found.append({"device": _stable_name(Path(device.path)), "description": text})
        except OSError as error:
            raise_shortage(error)
            found.append({"device": f"/dev/{number.name}", "description": f"cannot be opened: {error.strerror}"})
    return found


def _frames(device: Device, config: Config) -> Iterator[Frame | DroppedFrame]:
    if not device.is_camera:
        raise OSError(errno.ENOTTY, "not a camera")
    chosen = device.set_format(config.fourcc, config.width, config.height)
    if chosen.pixels not in ("MJPG", "YUYV"):
        has = ", ".join(device.pixel_formats())
        raise CameraUnavailable(f"{device.path} gives {chosen.pixels}, and MJPG or YUYV is needed; it has: {has}")
    if config.intrinsics is not None:
        check_fits(config.intrinsics, [(chosen.width, chosen.height)])
    device.set_rate(config.fps)
    if config.lock_exposure:
        run_free(device)
    device.start()
    settled, locked, frame_id = time.monotonic() + config.warmup_s, not config.lock_exposure, 0
    while True:
        raw = device.read(config.frame_timeout_s)
        if raw is None:
            raise CameraUnavailable(f"{device.path} gave no frame for {config.frame_timeout_s:g} s")
        if not locked and time.monotonic() < settled:
            continue
        if not locked:
            hold(device, config.exposure_us)
            locked = True
            continue  # it was exposed before
        item = _frame(raw, chosen, frame_id, config.intrinsics)
        frame_id += isinstance(item, Frame)
        yield item


def _frame(raw: RawFrame, chosen: Format, frame_id: int, intrinsics: Intrinsics | None) -> Frame | DroppedFrame:
    name = f"{raw.stamp_ns / 1e9:.6f}"
    if raw.damaged:
        return DroppedFrame(name, "the driver says that it is damaged")
    try:
        image = _decode(raw.data, chosen)
    except UnusableImage as error:
        return DroppedFrame(name, str(error))
    if intrinsics is not None:
        intrinsics = intrinsics.resized(image.shape[1], image.shape[0])
    encoded = raw.data if chosen.pixels == "MJPG" else None
    return make_frame(frame_id, name, raw.stamp_ns, image, intrinsics, encoded, wall_clock(raw.stamp_ns))


def _decode(data: bytes, chosen: Format) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises UnusableImage."""
    if chosen.pixels == "MJPG":
        return decode_image(data)[0]
    if len(data) < chosen.bytes_per_line * chosen.height:
        raise UnusableImage(f"truncated: {len(data)} of {chosen.bytes_per_line * chosen.height} bytes")
    lines = np.frombuffer(data, np.uint8, chosen.bytes_per_line * chosen.height)
    yuyv = lines.reshape(chosen.height, chosen.bytes_per_line)[:, : 2 * chosen.width]
    pixels = np.ascontiguousarray(yuyv).reshape(chosen.height, chosen.width, 2)
    return cv2.cvtColor(pixels, cv2.COLOR_YUV2RGB_YUY2).astype(np.uint8, copy=False)


def _only_camera(system: System | None) -> str:
    found = find(system)
    if len(found) != 1:
        raise CameraUnavailable(f"camera.device must say which camera; {_describe_cameras(found)}")
    return found[0]["device"]


def _explain(error: OSError, path: str, system: System | None) -> str:
    reasons = {
        errno.ENODEV: f"{path} was unplugged",
        errno.EBUSY: f"{path} is used by another program; close it",
        errno.EACCES: f"no right to open {path}; add this user to the group video",
        errno.ENOENT: f"no camera at {path}; {_describe_cameras(find(system))}",
        errno.ENOTTY: f"{path} is no camera; {_describe_cameras(find(system))}",
    }
    return reasons.get(error.errno or 0, f"{path}: {error.strerror or error}")


def _describe_cameras(found: list[dict[str, str]]) -> str:
    if not found:
        return "none is connected. Plug one in, then: splatnode list-cameras"
    return "found: " + "; ".join(f"{camera['device']} {camera['description']}" for camera in found)


def _stable_name(device: Path) -> str:
    """The name under which udev knows the camera by its serial number, else by its port, else its number."""
    for folder in (_BY_ID, _BY_PATH):
        links = sorted(folder.iterdir()) if folder.is_dir() else []
        for link in links:
            if link.resolve() == device.resolve():
                return str(link)
    return str(device)
