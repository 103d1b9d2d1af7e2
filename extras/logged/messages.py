"""What a message says, whatever it was encoded in: a picture, a calibration, depth."""

from __future__ import annotations

import heapq
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import MOST_PIXELS
from splatnode.capture.frame import LARGEST_NS, Clock, Intrinsics, Stamp
from splatnode.capture.image_file import UnusableImage, decode_image, decode_values
from splatnode.capture.process.config import record_in
from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.extras.logged.mcap import Message, Topic, UnusableLog, messages


class UnusableMessage(ValueError):
    """A message that cannot be read, or that shows no photograph; the text says why."""


@dataclass(frozen=True)
class Layout:
    """How the bytes of a raw image lie."""

    width: int  # pixels
    height: int  # pixels
    encoding: str  # as Foxglove and ROS name it: rgb8, bgr8, mono8, ...
    step: int  # bytes from row to row
    is_big_endian: bool = False  # of numbers of more than a byte


@dataclass(frozen=True)
class Picture:
    """An image, of one camera at one time."""

    sensor: str  # the name of the camera's coordinate frame, by which its calibration is found; may be empty
    captured_ns: int  # of the clock of who sent it, mostly since 1970
    data: bytes  # a JPEG, PNG or WebP file, or raw rows
    layout: Layout | None  # None: `data` is a file
    format: str = ""  # of a file, as its sender tells it: jpeg, png, 16UC1; compressedDepth png


@dataclass(frozen=True)
class Calibration:
    """A camera's calibration as it is sent: the centre of the top-left pixel is at (0, 0)."""

    sensor: str  # as of a Picture
    width: int  # of the whole images, pixels
    height: int  # likewise
    model: str  # of the distortion: plumb_bob, rational_polynomial, equidistant, kannala_brandt, fisheye, or empty
    D: tuple[float, ...]  # its coefficients
    K: tuple[float, ...]  # (9,) of the images as they are taken; K[0] = 0: not calibrated
    P: tuple[float, ...]  # (12,) of the images without distortion
    window: tuple[int, int, int, int] = (0, 0, 0, 0)  # x, y, width, height of what is sent; 0 wide: all


# The lens of an image topic: which calibration is its camera's, and what it says in splatnode's terms.

_MODELS = {  # how many coefficients a model has at most, and splatnode's name of it
    "": (0, "opencv"),
    "none": (0, "opencv"),
    "plumb_bob": (5, "opencv"),
    "rational_polynomial": (8, "opencv"),
    "equidistant": (4, "fisheye"),
    "kannala_brandt": (4, "fisheye"),
    "fisheye": (4, "fisheye"),
}
_WITHOUT_DISTORTION = "rect"  # in the last part of a topic's name: its images are rectified, as ROS names them


def calibration_topic(topic: str, sensor: str, known: Mapping[str, Calibration]) -> str | None:
    """The topic of `known` that calibrates the camera of `topic`, whose pictures are of `sensor`; None where none does.

    One of another sensor is not its camera's. Of the others it is the one that lies deepest in a namespace of the
    topic, as ROS has it: /front/camera_info is that of /front/image_raw/compressed.
    """
    of_sensor = [name for name, each in known.items() if not sensor or not each.sensor or sensor == each.sensor]
    above = [name for name in of_sensor if topic.startswith(_namespace(name))]
    if above:
        return max(above, key=lambda name: (len(_namespace(name)), name))
    named = [name for name in of_sensor if sensor and known[name].sensor == sensor]
    return named[0] if len(named) == 1 else None


def lens(topic: str, found: Calibration) -> Intrinsics | None:
    """The lens of the images of `topic`; None where the camera was not calibrated.

    Raises UnusableMessage where its model is not known here, or its numbers are no lens.
    """
    if len(found.K) != 9 or not found.K[0]:
        return None
    (fx, _, cx, _, fy, cy, *_), terms, model = found.K, found.D, found.model
    if _WITHOUT_DISTORTION in topic.rpartition("image")[2] and len(found.P) == 12 and found.P[0]:
        (fx, _, cx, _, _, fy, cy, *_), terms, model = found.P, (), ""
    terms = terms if any(terms) else ()
    if terms and model not in _MODELS:
        known = ", ".join(name for name in _MODELS if name)
        raise UnusableMessage(f"a lens must be one of {known}, it is {sanitize_text(model, 40)}")
    most, kind = _MODELS.get(model, (0, "opencv"))
    if len(terms) > most:
        raise UnusableMessage(
            f"a lens of {sanitize_text(model, 40) or 'no model'} has {most} numbers, got {len(terms)}"
        )
    x, y, width, height = found.window
    size = (width, height) if width and height else (found.width, found.height)
    try:  # ROS and Foxglove: the centre of the top-left pixel is at (0, 0)
        return Intrinsics(*size, fx, fy, cx - x + 0.5, cy - y + 0.5, "calibration", tuple(terms), kind)
    except ValueError as error:
        raise UnusableMessage(str(error)) from error


def _namespace(topic: str) -> str:
    return topic[: topic.rfind("/") + 1]


# Values of a ROS 2 message, one after the other.
#
# Source: OMG, DDS Interoperability Wire Protocol (CDR, plain): four bytes that tell the byte order, then values, each
# aligned to its size; a text has its length before it and a zero behind it.

_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}  # of plain CDR
_HEAD = 4  # bytes


class Cdr:
    """A message that is read from its beginning. All methods raise UnusableMessage where it ends too early."""

    def __init__(self, data: bytes) -> None:
        order = _ORDERS.get(data[:2])
        if order is None:
            raise UnusableMessage(f"the message must be plain CDR, it begins with {data[:2].hex() or 'nothing'}")
        self._data, self._order, self._place = memoryview(data)[_HEAD:], order, 0

    def integer(self) -> int:
        """uint32."""
        return self._numbers("I", 4, 1)[0]

    def time_ns(self) -> int:
        """builtin_interfaces/Time; what is before 1970 is 0."""
        (seconds,) = self._numbers("i", 4, 1)
        return max(0, seconds * 10**9 + self.integer())

    def byte(self) -> int:
        return self._numbers("B", 1, 1)[0]

    def text(self) -> str:
        return self._take(self.integer()).rstrip(b"\0").decode(errors="replace")

    def bytes(self) -> bytes:
        """A sequence of uint8."""
        return self._take(self.integer())

    def doubles(self, count: int | None = None) -> tuple[float, ...]:
        """An array of `count` float64; None: a sequence."""
        return self._numbers("d", 8, self.integer() if count is None else count)

    def _numbers(self, kind: str, size: int, count: int) -> tuple:
        if count:
            self._place += -self._place % size
        return struct.unpack(f"{self._order}{count}{kind}", self._take(size * count))

    def _take(self, length: int) -> bytes:
        if self._place + length > len(self._data):
            raise UnusableMessage(f"the message ends within a value of {length} bytes")
        self._place += length
        return bytes(self._data[self._place - length : self._place])


# The fields of a protobuf message by their numbers.
#
# Source: Protocol Buffers, Encoding (the wire format). A message of a few known fields takes no generated code.

_VARINT, _EIGHT_BYTES, _BYTES, _FOUR_BYTES = 0, 1, 2, 5  # wire types
_LONGEST_VARINT = 10  # bytes of 64 bits


class Fields:
    """The fields of a message; one that it does not hold is 0, empty, or no message, as protobuf says."""

    def __init__(self, data: bytes) -> None:
        """Raises UnusableMessage."""
        self._values: defaultdict[int, list[int | bytes]] = defaultdict(list)
        place = 0
        while place < len(data):
            key, place = _varint(data, place)
            value, place = _value(data, place, key & 7)
            self._values[key >> 3].append(value)

    def integer(self, number: int) -> int:
        """A varint, or four bytes."""
        value = self._last(number)
        return value if isinstance(value, int) else int.from_bytes(value, "little")

    def bytes(self, number: int) -> bytes:
        value = self._last(number)
        return value if isinstance(value, bytes) else b""

    def text(self, number: int) -> str:
        return self.bytes(number).decode(errors="replace")

    def message(self, number: int) -> Fields:
        return Fields(self.bytes(number))

    def messages(self, number: int) -> list[Fields]:
        """A repeated message."""
        return [Fields(value) for value in self._values[number] if isinstance(value, bytes)]

    def doubles(self, number: int) -> tuple[float, ...]:
        """Repeated numbers, packed as proto3 writes them, or one by one."""
        packed = b"".join(value for value in self._values[number] if isinstance(value, bytes))
        if len(packed) % 8:
            raise UnusableMessage(f"field {number} must be numbers of 8 bytes, has {len(packed)} bytes")
        return struct.unpack(f"<{len(packed) // 8}d", packed)

    def _last(self, number: int) -> int | bytes:
        return self._values[number][-1] if self._values[number] else b""


def _value(data: bytes, place: int, kind: int) -> tuple[int | bytes, int]:
    if kind == _VARINT:
        return _varint(data, place)
    if kind == _BYTES:
        length, place = _varint(data, place)
    elif kind in (_EIGHT_BYTES, _FOUR_BYTES):
        length = 8 if kind == _EIGHT_BYTES else 4
    else:
        raise UnusableMessage(f"a protobuf message has wire types 0, 1, 2 and 5, got {kind}")
    if place + length > len(data):
        raise UnusableMessage(f"the message ends within a field of {length} bytes")
    return data[place : place + length], place + length


def _varint(data: bytes, place: int) -> tuple[int, int]:
    number = 0
    for index in range(_LONGEST_VARINT):
        if place + index >= len(data):
            raise UnusableMessage("the message ends within a number")
        byte = data[place + index]
        number |= (byte & 127) << 7 * index
        if byte < 128:
            return number, place + index + 1
    raise UnusableMessage("a number has more than 64 bits")


# Foxglove's CompressedImage, RawImage and CameraCalibration, in JSON and in protobuf.
#
# Source: Foxglove's schemas (foxglove-sdk), whose field numbers are those below.

_NS = 10**9
_Message = TypeVar("_Message", bound=msgspec.Struct)


class _Time(msgspec.Struct, frozen=True):
    sec: int = 0
    nsec: int = 0

    @property
    def ns(self) -> int:
        return max(0, self.sec * _NS + self.nsec)


class _Compressed(msgspec.Struct, frozen=True):
    data: bytes  # base64 in JSON
    timestamp: _Time = _Time()
    frame_id: str = ""
    format: str = ""


class _Raw(msgspec.Struct, frozen=True):
    width: int
    height: int
    encoding: str
    step: int
    data: bytes
    timestamp: _Time = _Time()
    frame_id: str = ""


class _Calibration(msgspec.Struct, frozen=True):
    width: int
    height: int
    K: tuple[float, ...]
    distortion_model: str = ""
    D: tuple[float, ...] = ()
    P: tuple[float, ...] = ()
    frame_id: str = ""


def parse_compressed_json(data: bytes) -> Picture:
    found = _parse_json(data, _Compressed)
    return Picture(found.frame_id, found.timestamp.ns, found.data, None, found.format)


def parse_raw_json(data: bytes) -> Picture:
    found = _parse_json(data, _Raw)
    layout = Layout(found.width, found.height, found.encoding, found.step)
    return Picture(found.frame_id, found.timestamp.ns, found.data, layout)


def parse_calibration_json(data: bytes) -> Calibration:
    found = _parse_json(data, _Calibration)
    return Calibration(found.frame_id, found.width, found.height, found.distortion_model, found.D, found.K, found.P)


def parse_compressed_protobuf(data: bytes) -> Picture:
    fields = Fields(data)
    return Picture(fields.text(4), _time_ns(fields.message(1)), fields.bytes(2), None, fields.text(3))


def parse_raw_protobuf(data: bytes) -> Picture:
    fields = Fields(data)
    layout = Layout(fields.integer(2), fields.integer(3), fields.text(4), fields.integer(5))
    return Picture(fields.text(7), _time_ns(fields.message(1)), fields.bytes(6), layout)


def parse_calibration_protobuf(data: bytes) -> Calibration:
    fields = Fields(data)
    size = fields.integer(2), fields.integer(3)
    return Calibration(fields.text(9), *size, fields.text(4), fields.doubles(5), fields.doubles(6), fields.doubles(8))


def _time_ns(stamp: Fields) -> int:
    """google.protobuf.Timestamp."""
    return stamp.integer(1) * _NS + stamp.integer(2)


def _parse_json(data: bytes, kind: type[_Message]) -> _Message:
    try:
        return record_in(data, kind)
    except msgspec.DecodeError as error:
        raise UnusableMessage(f"the message must be JSON of Foxglove's schema: {error}") from error


# A message's picture as an RGB image.

_CODES = {  # bytes a pixel, and OpenCV's conversion to RGB; None: it is RGB
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    # OpenCV names a pattern by its second row's second and third pixels, the others by its first two.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
}

DEPTH_TYPES = {"16UC1": np.dtype(np.uint16), "32FC1": np.dtype(np.float32)}  # millimetres, metres (ROS' REP 118)


def find_encoding(picture: Picture) -> str:
    """Returns the encoding of its pixels; of a file what its format has before the semicolon, empty where nothing."""
    return picture.layout.encoding if picture.layout else picture.format.partition(";")[0].strip()


def is_depth_image(picture: Picture) -> bool:
    """Whether its pixels are depths."""
    return find_encoding(picture) in DEPTH_TYPES


def is_colour_image(picture: Picture) -> bool:
    """Whether its pixels are those of a photograph; those of depth are not."""
    return not is_depth_image(picture) if picture.layout is None else picture.layout.encoding in _CODES


def rgb(picture: Picture, max_pixels: int) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises UnusableMessage."""
    if picture.layout is None:
        try:
            return decode_image(picture.data, max_pixels).image
        except UnusableImage as error:
            raise UnusableMessage(str(error)) from error
    return _decode_rows(picture.data, picture.layout, max_pixels)


def _decode_rows(data: bytes, layout: Layout, max_pixels: int) -> npt.NDArray[np.uint8]:
    if layout.encoding not in _CODES:
        raise UnusableMessage(
            f"an image must have an encoding of {', '.join(_CODES)}, it has "
            f"{sanitize_text(layout.encoding, 40) or 'none'}"
        )
    channels, code = _CODES[layout.encoding]
    pixels = read_rows(data, layout, channels, max_pixels)
    try:
        image = pixels if code is None else cv2.cvtColor(pixels, code)
    except cv2.error as error:  # such as a Bayer pattern of one row
        size = f"{layout.width} x {layout.height}"
        raise UnusableMessage(f"{size} of {layout.encoding} cannot be converted: {error.err}") from error
    return image.astype(np.uint8, copy=False)


def read_rows(data: bytes, layout: Layout, num_bytes: int, max_pixels: int) -> npt.NDArray[np.uint8]:
    """(H, W, num_bytes) the bytes of each pixel of a raw image. Raises UnusableMessage where they are not there."""
    width, height, row = layout.width, layout.height, layout.width * num_bytes
    if not 0 < width * height <= max_pixels:
        raise UnusableMessage(f"{width} x {height}: an image must have 1 to {max_pixels} pixels")
    if layout.step < row or len(data) < layout.step * (height - 1) + row:
        raise UnusableMessage(
            f"{width} x {height} of {num_bytes} bytes must have rows of {row} bytes or more, it has rows of "
            f"{layout.step} and {len(data)} bytes in all"
        )
    rows = np.ndarray((height, row), np.uint8, data, strides=(layout.step, 1))  # no copy of what a step leaves out
    return np.ascontiguousarray(rows).reshape(height, width, num_bytes)


# sensor_msgs/CompressedImage, Image and CameraInfo of ROS 2. Source: common_interfaces' message definitions.


def parse_compressed_image(data: bytes) -> Picture:
    values = Cdr(data)
    captured_ns, sensor, format_text = values.time_ns(), values.text(), values.text()
    return Picture(sensor, captured_ns, values.bytes(), None, format_text)


def parse_raw_image(data: bytes) -> Picture:
    values = Cdr(data)
    captured_ns, sensor = values.time_ns(), values.text()
    height, width = values.integer(), values.integer()
    encoding, big_endian, step = values.text(), values.byte(), values.integer()
    return Picture(sensor, captured_ns, values.bytes(), Layout(width, height, encoding, step, big_endian > 0))


def parse_camera_info(data: bytes) -> Calibration:
    values = Cdr(data)
    values.time_ns()
    sensor, height, width, model = values.text(), values.integer(), values.integer(), values.text()
    D, K, _R, P = values.doubles(), values.doubles(9), values.doubles(9), values.doubles(12)
    _across, _down = values.integer(), values.integer()  # binning: the image's size tells it
    x, y, window_height, window_width = (values.integer() for _ in range(4))
    return Calibration(sensor, width, height, model, D, K, P, (x, y, window_width, window_height))


# Which messages are pictures and calibrations, and what reads them.

# By the schema's name and the messages' encoding, as MCAP has them.
PICTURES: dict[tuple[str, str], Callable[[bytes], Picture]] = {
    ("foxglove.CompressedImage", "json"): parse_compressed_json,
    ("foxglove.CompressedImage", "protobuf"): parse_compressed_protobuf,
    ("foxglove.RawImage", "json"): parse_raw_json,
    ("foxglove.RawImage", "protobuf"): parse_raw_protobuf,
    ("sensor_msgs/msg/CompressedImage", "cdr"): parse_compressed_image,
    ("sensor_msgs/msg/Image", "cdr"): parse_raw_image,
}
CALIBRATIONS: dict[tuple[str, str], Callable[[bytes], Calibration]] = {
    ("foxglove.CameraCalibration", "json"): parse_calibration_json,
    ("foxglove.CameraCalibration", "protobuf"): parse_calibration_protobuf,
    ("sensor_msgs/msg/CameraInfo", "cdr"): parse_camera_info,
}
READ = (
    "foxglove.CompressedImage and RawImage in JSON or protobuf, and sensor_msgs/msg/CompressedImage and Image of ROS 2"
)


# The messages of an image topic in the order of their times, by the clock of who took the images where it tells.
#
# Writers may log messages late, many at one time, or in any order; simulations count from their own beginning.

EARLIEST_UTC_NS = 946_684_800 * 10**9  # the year 2000: a smaller stamp is of a clock that began with the recording
_MAX_HELD_BYTES = 1 << 28  # of messages that wait for earlier ones; what is beyond is read again


@dataclass(frozen=True)
class MessageTime:
    """When a message was taken and logged."""

    place: int  # among the messages of its topic, as they lie in the file
    log_ns: int  # when it was written down
    stream_ns: int  # when its image comes in the stream; never before that of an earlier image
    captured_at: Stamp | None  # None: no clock can count so far
    is_stamped: bool = True  # `stream_ns` is of the headers; False: of the log


def read_picture(message: Message) -> Picture:
    """Parses a message of an image topic. Raises UnusableMessage."""
    with guard_untrusted(UnusableMessage):
        return PICTURES[message.topic.kind](message.data)


def read_times(file: Path, topic: Topic) -> tuple[MessageTime, ...]:
    """The times of all messages of an image topic, in their order; equal ones in that of the file.

    All messages are read, and no image is decoded. A time is that of the message's header, also where a simulation
    counts it from its own beginning; it is the log's where no header of the topic tells any. Where all headers tell one
    time, the stream has the times of the log. Raises OSError; a damaged file is read as far as it goes.
    """
    header_stamps: list[tuple[int, int | None]] = []  # the log's time, and the header's; None: it cannot be read
    with suppress(UnusableLog):
        for message in messages(file, {topic.name}):
            try:
                header_stamps.append((message.log_ns, read_picture(message).captured_ns))
            except UnusableMessage:
                header_stamps.append((message.log_ns, None))
    headers = [header for _, header in header_stamps if header is not None]
    latest = max(headers, default=0)
    is_one_time = len(headers) > 1 and min(headers) == latest
    found: list[MessageTime] = []
    for place, (log_ns, header) in enumerate(header_stamps):
        # A header of 0 is the beginning of a simulation, or was never filled in where others tell the time of day.
        uses_header = header is not None and latest > 0 and (header > 0 or latest < EARLIEST_UTC_NS)
        captured_ns = header if uses_header and header is not None else log_ns
        stream_ns = log_ns if is_one_time else captured_ns
        if header is None and found and not is_one_time:
            stream_ns = found[-1].stream_ns  # it is left out, where it lies
        found.append(MessageTime(place, log_ns, stream_ns, _stamp(captured_ns), uses_header and not is_one_time))
    return tuple(sorted(found, key=lambda each: each.stream_ns))


def read_in_order(file: Path, topic: Topic, times: Sequence[MessageTime]) -> Iterator[tuple[Message, MessageTime]]:
    """The messages of the topic in the order of `times`, which `read_times` gave.

    A file in order is read once. Of one in disorder as many messages wait in memory as there is room for; the others
    are read again. Raises UnusableLog, after all messages before the damage; OSError.
    """
    ranks = {each.place: rank for rank, each in enumerate(times)}
    held: dict[int, Message] = {}
    heap: list[int] = []  # of the ranks in `held`, negative: the last one first
    held_bytes = rank = 0
    problem: UnusableLog | None = None
    while rank < len(times):
        before = rank
        try:
            for place, message in enumerate(messages(file, {topic.name})):
                mine = ranks.get(place, -1)
                if mine < rank or mine in held:
                    continue
                held[mine] = message
                heapq.heappush(heap, -mine)
                held_bytes += len(message.data)
                while rank in held:
                    ready = held.pop(rank)
                    held_bytes -= len(ready.data)
                    yield ready, times[rank]
                    rank += 1
                while held_bytes > _MAX_HELD_BYTES and len(held) > 1:
                    last = -heapq.heappop(heap)
                    if last in held:
                        held_bytes -= len(held.pop(last).data)
        except UnusableLog as error:
            problem = error
        if rank == before:
            raise problem or UnusableLog("it changed while it was read; read it again when it is complete")
    if problem is not None:
        raise problem


def _stamp(captured_ns: int) -> Stamp | None:
    if captured_ns > LARGEST_NS:
        return None
    return Stamp(captured_ns, Clock.UTC if captured_ns >= EARLIEST_UTC_NS else Clock.RECORDING)


# The depth that a message of an image topic holds: raw, or packed into a PNG as ROS' compressedDepth has it.
#
# Source: ROS' compressed_depth_image_transport. Its files have 12 bytes before the PNG: how depth was packed, and two
# numbers a and b. Of 16UC1 the PNG has millimetres, of 32FC1 values v for a depth of a / (v - b) metres.

_DEPTH_HEAD = struct.Struct("<iff")  # before the PNG of compressedDepth
_PACKED = "compressedDepth"  # in the format of a file that has such a head
_METRES, _PNG = "32FC1", b"\x89PNG"


def decode_depth(picture: Picture) -> npt.NDArray[np.uint16] | npt.NDArray[np.float32]:
    """(H, W) millimetres, or metres where they are floats; 0, or no finite number, where nothing was measured.

    Raises UnusableMessage.
    """
    encoding = find_encoding(picture)
    if encoding not in DEPTH_TYPES:
        raise UnusableMessage(
            f"a depth image must have an encoding of {' or '.join(DEPTH_TYPES)}, it has "
            f"{sanitize_text(encoding, 40) or 'none'}"
        )
    with guard_untrusted(UnusableMessage, "a depth image"):
        if picture.layout is not None:
            return _decode_depth_rows(picture.data, picture.layout)
        return _decode_file(picture.data, picture.format, encoding)


def _decode_depth_rows(data: bytes, layout: Layout) -> npt.NDArray:
    kind = DEPTH_TYPES[layout.encoding]
    pixels = read_rows(data, layout, kind.itemsize, MOST_PIXELS)
    values = pixels.view(kind.newbyteorder(">" if layout.is_big_endian else "<"))[..., 0]
    return values.astype(kind, copy=False)


def _decode_file(data: bytes, format_text: str, encoding: str) -> npt.NDArray:
    """Decodes what a sender of this format packed. Raises UnusableMessage."""
    way = format_text.partition(";")[2]
    if "rvl" in way.lower():
        raise UnusableMessage(
            "depth that was packed by RVL is not read; log the raw topic, or compressedDepth with the format png"
        )
    is_packed = _PACKED in way
    if is_packed and len(data) < _DEPTH_HEAD.size:
        raise UnusableMessage(f"{_PACKED} must have {_DEPTH_HEAD.size} bytes before its PNG, it has {len(data)} in all")
    png = data[_DEPTH_HEAD.size :] if is_packed else data
    if not png.startswith(_PNG):
        raise UnusableMessage(f"a file of depth must be a PNG, it begins with {png[:4].hex() or 'nothing'}")
    try:
        values = decode_values(png, MOST_PIXELS)
    except UnusableImage as error:
        raise UnusableMessage(str(error)) from error
    if values.ndim != 2 or values.dtype != np.uint16:
        raise UnusableMessage(f"a file of depth must be (H, W) of 16 bits, it is {values.shape} {values.dtype}")
    if encoding != _METRES:
        return values
    if not is_packed:
        raise UnusableMessage(f"a file of {_METRES} must be {_PACKED}, it is {sanitize_text(format_text, 40)}")
    _, a, b = _DEPTH_HEAD.unpack_from(data)
    if not (0 < a < np.inf and abs(b) < np.inf):
        raise UnusableMessage(f"{_PACKED} of {_METRES} must tell how depth was packed, it has a = {a:g} and b = {b:g}")
    with np.errstate(divide="ignore", over="ignore"):
        metres = np.float32(a) / (values.astype(np.float32) - np.float32(b))
    return np.where((values > 0) & np.isfinite(metres), metres, np.float32(0))
