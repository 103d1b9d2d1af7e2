"""A message as a file: as it goes over the wire, with a checksum, whole or not there."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from splatnode.capture.messaging.wire import MAGIC, VERSION, Part
from splatnode.capture.process.durable import write_atomically
from splatnode.capture.process.private import read_own

LARGEST = 4 << 30  # bytes of a body, unless the reader knows better

_HEAD = struct.Struct("<8sIQI")  # magic, parts, bytes of the body, its CRC-32
_MAGIC = b"SPLSPOOL"
_SIZE = struct.Struct("<Q")
# Of files that earlier versions wrote: what they lack in today's headers has a default.
_EARLIER = tuple(MAGIC[:-1] + bytes([version]) for version in range(1, VERSION))


def size_in_file(parts: Sequence[Part]) -> int:
    """Bytes of the body that `write_message` writes."""
    return sum(_SIZE.size + memoryview(part).nbytes for part in parts)


def write_message(path: Path, parts: Sequence[Part]) -> None:
    """Returns when the message is on the disk. Raises OSError, with what was there before intact."""
    body = [piece for part in parts for piece in (_SIZE.pack(memoryview(part).nbytes), part)]
    checksum = 0
    for piece in body:
        checksum = zlib.crc32(piece, checksum)
    write_atomically(path, [_HEAD.pack(_MAGIC, len(parts), size_in_file(parts), checksum), *body])


class MessageFileError(ValueError):
    """The file is no message that was written here, or the disk has lost a part of it; the text names it."""


def read_message(path: Path, most_bytes: int = LARGEST) -> list[Part]:
    """The parts as they were written. Raises OSError, MessageFileError; StrayFile for a link, a pipe, a larger file."""
    content = memoryview(read_own(path, most_bytes + _HEAD.size))
    if len(content) < _HEAD.size:
        raise MessageFileError(f"{path} is no stored message")
    magic, count, size, checksum = _HEAD.unpack_from(content)
    body = content[_HEAD.size :]
    if magic != _MAGIC or len(body) != size or zlib.crc32(body) != checksum:
        raise MessageFileError(f"{path} is damaged")
    parts: list[Part] = list(_parts(body, count, path))
    return [MAGIC, *parts[1:]] if parts and parts[0] in _EARLIER else parts


def _parts(body: memoryview, count: int, path: Path) -> Iterator[memoryview]:
    for _ in range(count):
        length = _SIZE.unpack_from(body)[0] if len(body) >= _SIZE.size else 0
        if not 0 <= length <= len(body) - _SIZE.size:
            raise MessageFileError(f"{path} is damaged: its {count} parts are larger than the file")
        yield body[_SIZE.size : _SIZE.size + length]
        body = body[_SIZE.size + length :]
    if len(body):
        raise MessageFileError(f"{path} is damaged: its {count} parts are smaller than the file")
