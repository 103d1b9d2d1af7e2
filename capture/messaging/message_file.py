"""A message as a file: as it goes over the wire, with a checksum, whole or not there."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

from splatnode.capture.messaging.wire import Part
from splatnode.capture.process.durable import write_whole

_HEAD = struct.Struct("<8sIQI")  # magic, parts, bytes of the body, its CRC-32
_MAGIC = b"SPLSPOOL"
_SIZE = struct.Struct("<Q")


def size_in_file(parts: Sequence[Part]) -> int:
    """Bytes of the body that `write_message` writes."""
    return sum(_SIZE.size + memoryview(part).nbytes for part in parts)


def write_message(path: Path, parts: Sequence[Part]) -> None:
    """Returns when the message is on the disk. Raises OSError, with what was there before intact."""
    body = [piece for part in parts for piece in (_SIZE.pack(memoryview(part).nbytes), part)]
    checksum = 0
    for piece in body:
        checksum = zlib.crc32(piece, checksum)
    write_whole(path, [_HEAD.pack(_MAGIC, len(parts), size_in_file(parts), checksum), *body])


def read_message(path: Path) -> list[Part]:
    """The parts as they were written. Raises OSError, and ValueError where the disk has lost them."""
    content = memoryview(path.read_bytes())
    if len(content) < _HEAD.size:
        raise ValueError(f"{path} is no stored message")
    magic, count, size, checksum = _HEAD.unpack_from(content)
    body = content[_HEAD.size :]
    if magic != _MAGIC or len(body) != size or zlib.crc32(body) != checksum:
        raise ValueError(f"{path} is damaged")
    parts: list[Part] = []
    position = 0
    for _ in range(count):
        (length,) = _SIZE.unpack_from(body, position)
        parts.append(body[position + _SIZE.size : position + _SIZE.size + length])
        position += _SIZE.size + length
    return parts
