"""What robots log: messages of ROS 2 (CDR), protobuf and Foxglove's JSON, and MCAP files from their records."""

from __future__ import annotations

import base64
import random
import struct
import zlib

import numpy as np

from tests.support.adversary import documents, edges, images

_ENCODINGS = (
    "rgb8",
    "bgr8",
    "8UC3",
    "rgba8",
    "mono8",
    "yuv422",
    "yuyv",
    "bayer_rggb8",
    "16UC1",
    "32FC1",
    "",
    "\x1b[2J",
)
_K = (20.0, 0.0, 8.0, 0.0, 20.0, 6.0, 0.0, 0.0, 1.0)
_MAGIC = b"\x89MCAP0\r\n"
MESSAGES = (
    "compressed cdr",
    "raw cdr",
    "calibration cdr",
    "compressed json",
    "raw json",
    "calibration json",
    "compressed protobuf",
    "raw protobuf",
    "calibration protobuf",
    "depth cdr",
)
_DEPTH_FORMATS = ("16UC1; compressedDepth png", "32FC1; compressedDepth png", "16UC1; png compressed ")


def logged(rng: random.Random) -> tuple[bytes, bytes]:
    """The kind of a message (one of MESSAGES), and its bytes."""
    kind = rng.choice(MESSAGES)
    return kind.encode(), message(rng, kind)


def message(rng: random.Random, kind: str) -> bytes:
    what, encoding = kind.split()
    data = {"cdr": _cdr, "json": _json, "protobuf": _protobuf}[encoding](rng, what)
    return edges.damaged(rng, data, 1) if rng.random() < 0.15 else data


def _size(rng: random.Random) -> tuple[int, int]:
    return (16, 12) if rng.random() < 0.7 else (edges.unsigned(rng, 32), edges.unsigned(rng, 32))


def _rows(rng: random.Random, encoding: str, width: int, height: int) -> tuple[int, bytes]:
    channels = 3 if "8UC3" in encoding or encoding in ("rgb8", "bgr8") else 4 if encoding == "rgba8" else 2
    step = width * channels if rng.random() < 0.8 else edges.unsigned(rng, 32)
    size = step * height if step * height < 5000 and rng.random() < 0.9 else rng.choice((0, 100))
    return step % 2**32, bytes(size)


class _Writer:
    """CDR that may lie: each length is now and then another one."""

    def __init__(self, rng: random.Random) -> None:
        self._rng, self._order = rng, rng.choice("<<<>")
        self._body = b""

    def value(self, kind: str, *numbers: float) -> None:
        size = struct.calcsize(kind)
        self._body += bytes(-len(self._body) % size) + struct.pack(f"{self._order}{len(numbers)}{kind}", *numbers)

    def length(self, length: int) -> None:
        self.value("I", length if self._rng.random() < 0.97 else edges.unsigned(self._rng, 32))

    def text(self, text: str) -> None:
        data = text.encode("utf-8", "surrogatepass") + b"\0"
        self.length(len(data))
        self._body += data

    def bytes(self, data: bytes) -> None:
        self.length(len(data))
        self._body += data

    def whole(self) -> bytes:
        head = b"\0\1\0\0" if self._order == "<" else b"\0\0\0\0"
        return (head if self._rng.random() < 0.97 else self._rng.randbytes(4)) + self._body


def _cdr(rng: random.Random, what: str) -> bytes:
    to = _Writer(rng)
    to.value("i", rng.choice((0, 1_700_000_000, -1, 2**31 - 1)))
    to.value("I", rng.choice((0, 1, 2**32 - 1)))
    to.text(rng.choice(("camera", "", edges.text(rng))))
    if what == "compressed":
        to.text("jpeg")
        to.bytes(images.sound(".jpg") if rng.random() < 0.7 else images.image(rng))
        return to.whole()
    if what == "depth":
        to.text(rng.choice((*_DEPTH_FORMATS, *_DEPTH_FORMATS, "16UC1; compressedDepth rvl", edges.text(rng))))
        to.bytes(_packed_depth(rng))
        return to.whole()
    width, height = _size(rng)
    to.value("I", height)
    to.value("I", width)
    if what == "raw":
        encoding = rng.choice(_ENCODINGS)
        to.text(encoding)
        to.value("B", rng.randrange(2))
        step, data = _rows(rng, encoding, width, height)
        to.value("I", step)
        to.bytes(data)
        return to.whole()
    to.text(rng.choice(("plumb_bob", "equidistant", "rational_polynomial", "", "fisheye", edges.text(rng))))
    terms = _doubles(rng, [0.01] * rng.choice((0, 4, 5, 8, 12)))
    to.length(len(terms))
    for numbers in (terms, _doubles(rng, _K), _doubles(rng, [1.0, 0, 0, 0, 1, 0, 0, 0, 1]), _doubles(rng, [20.0] * 12)):
        if numbers:
            to.value("d", *numbers)
    for _ in range(6):
        to.value("I", 0 if rng.random() < 0.8 else edges.unsigned(rng, 32))
    return to.whole()


def _packed_depth(rng: random.Random) -> bytes:
    """What ROS' compressedDepth has: a head, and a PNG of 16 bits."""
    numbers = (100.0, 1.0) if rng.random() < 0.7 else (edges.number(rng), edges.number(rng))
    head = struct.pack("<i", rng.choice((0, 1, -1))) + b"".join(_single(each) for each in numbers)
    png = images.deep_png() if rng.random() < 0.7 else images.png(rng)
    return head[: rng.choice((12, 12, 12, 12, 5))] + png


def _single(number: float) -> bytes:
    """Four bytes; a number that they do not hold becomes infinite."""
    return np.float32(min(max(number, -3e38), 3e38)).tobytes()


def _doubles(rng: random.Random, usual: object) -> list[float]:
    odd = rng.choice((0.0, 0.0, 0.1))
    return [edges.number(rng) if rng.random() < odd else float(number) for number in usual]  # pyright: ignore


def _json(rng: random.Random, what: str) -> bytes:
    told: dict[str, object] = {"timestamp": {"sec": 1_700_000_000, "nsec": 5}, "frame_id": "camera"}
    width, height = _size(rng)
    if what == "compressed":
        told["data"] = base64.b64encode(images.sound(".jpg")).decode()
    elif what == "raw":
        encoding = rng.choice(_ENCODINGS)
        step, data = _rows(rng, encoding, width, height)
        told |= {"width": width, "height": height, "encoding": encoding, "step": step}
        told["data"] = base64.b64encode(data).decode()
    else:
        told |= {"width": width, "height": height, "K": list(_K), "D": [0.01] * 5, "distortion_model": "plumb_bob"}
    return documents.json_file(rng, told)


def _varint(number: int) -> bytes:
    number %= 2**64
    data = bytearray()
    while True:
        data.append(number & 127 | (128 if number > 127 else 0))
        number >>= 7
        if not number:
            return bytes(data)


def _field(rng: random.Random, number: int, content: int | bytes) -> bytes:
    kind = 0 if isinstance(content, int) else 2
    key = _varint(number << 3 | (kind if rng.random() < 0.98 else rng.randrange(8)))
    if isinstance(content, int):
        return key + _varint(content if rng.random() < 0.9 else edges.integer(rng))
    return key + _varint(len(content) if rng.random() < 0.97 else edges.integer(rng)) + content


def _protobuf(rng: random.Random, what: str) -> bytes:
    width, height = _size(rng)
    stamp = _field(rng, 1, 1_700_000_000) + _field(rng, 2, 5)
    fields = [_field(rng, 1, stamp)]
    if what == "compressed":
        fields += [_field(rng, 2, images.sound(".jpg")), _field(rng, 3, b"jpeg"), _field(rng, 4, b"camera")]
    elif what == "raw":
        encoding = rng.choice(_ENCODINGS)
        step, data = _rows(rng, encoding, width, height)
        fields += [_field(rng, 2, width), _field(rng, 3, height), _field(rng, 4, encoding.encode())]
        fields += [_field(rng, 5, step), _field(rng, 6, data), _field(rng, 7, b"camera")]
    else:
        fields += [_field(rng, 2, width), _field(rng, 3, height), _field(rng, 4, b"plumb_bob")]
        for number, usual in ((5, [0.01] * 5), (6, _K), (8, [20.0] * 12)):
            numbers = _doubles(rng, usual)
            fields.append(_field(rng, number, struct.pack(f"<{len(numbers)}d", *numbers)))
    if rng.random() < 0.1:
        rng.shuffle(fields)
    return b"".join(fields)


def mcap(rng: random.Random) -> bytes:
    """A file of a few messages, in a chunk or not, with an index or not; numbers in its records may be anything."""
    share = rng.choice((0.0, 0.0, 0.01, 0.1))

    def number(usual: int, layout: str) -> bytes:
        bits = 8 * struct.calcsize(layout)
        return struct.pack("<" + layout, usual if rng.random() >= share else edges.unsigned(rng, bits))

    def text(usual: str) -> bytes:
        data = (usual if rng.random() >= share else edges.text(rng)).encode("utf-8", "surrogatepass")
        return number(len(data), "I") + data

    def record(kind: int, content: bytes) -> bytes:
        return bytes([kind if rng.random() >= share / 2 else rng.randrange(256)]) + number(len(content), "Q") + content

    kind = rng.choice(MESSAGES)
    what, encoding = kind.split()
    schema = {"raw": "RawImage", "calibration": "CameraCalibration"}.get(what, "CompressedImage")
    if encoding == "cdr":
        schema = "sensor_msgs/msg/" + {"raw": "Image", "calibration": "CameraInfo"}.get(what, "CompressedImage")
    else:
        schema = f"foxglove.{schema}"
    told = record(3, number(1, "H") + text(schema) + text("ros2msg") + number(0, "I"))
    told += record(4, number(1, "H") + number(1, "H") + text("/front") + text(encoding) + number(0, "I"))
    has_depth = rng.random() < 0.4
    if has_depth:
        packed = text("sensor_msgs/msg/CompressedImage")
        told += record(3, number(2, "H") + packed + text("ros2msg") + number(0, "I"))
        told += record(4, number(2, "H") + number(2, "H") + text("/depth") + text("cdr") + number(0, "I"))
    body, places = told, []
    for index in range(rng.choice((0, 1, 2, 3))):
        places.append(len(body))
        times = number(1_700_000_000 * 10**9 + index, "Q") * 2
        body += record(5, number(1, "H") + number(index, "I") + times + message(rng, kind))
        if has_depth:
            body += record(5, number(2, "H") + number(index, "I") + times + message(rng, "depth cdr"))
    head = _MAGIC + record(1, text("") + text("adversary"))
    if rng.random() < 0.4:
        return head + body + record(15, number(0, "I")) + _footer(number, 0)
    compression, packed = rng.choice((("", body), ("", body), *_packed(body)))
    crc = number(zlib.crc32(body), "I") if rng.random() < 0.5 else number(0, "I")
    chunk = number(0, "Q") * 2 + number(len(body), "Q") + crc + text(compression) + number(len(packed), "Q") + packed
    index_record = number(1, "H") + number(16 * len(places), "I") + b"".join(number(p, "Q") * 2 for p in places)
    start, data = len(head), head + record(6, chunk) + record(7, index_record)
    data += record(15, number(0, "I"))
    summary = len(data)
    behind = number(start + 9 + len(chunk), "Q")
    offsets = number(20, "I") + number(1, "H") + behind + number(2, "H") + behind
    entry = (
        number(0, "Q") * 2 + number(start, "Q") + number(9 + len(chunk), "Q") + offsets + number(len(index_record), "Q")
    )
    entry += text(compression) + number(len(packed), "Q") + number(len(body), "Q")
    many = rng.choice((1, 1, 1, 2, 200 if share else 1))
    return data + told + record(8, entry) * many + _footer(number, summary)


def _packed(body: bytes) -> list[tuple[str, bytes]]:
    import lz4.frame
    import zstandard

    return [("lz4", lz4.frame.compress(body)), ("zstd", zstandard.ZstdCompressor(1).compress(body)), ("brotli", body)]


def _footer(number: object, summary: int) -> bytes:
    fields = struct.pack("<QQI", summary, 0, 0)
    return b"\2" + struct.pack("<Q", len(fields)) + fields + _MAGIC
