"""The kernel's structs and request numbers, from linux/videodev2.h; ctypes lays them out as the C compiler does."""

from __future__ import annotations

import ctypes as c

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


class Format(c.Structure):
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
S_FMT = _request(_READ | _WRITE, 5, Format)
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
