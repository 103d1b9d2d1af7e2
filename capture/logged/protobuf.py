"""The fields of a protobuf message by their numbers.

Source: Protocol Buffers, Encoding (the wire format). A message of a few known fields takes no generated code.
"""

from __future__ import annotations

import struct
from collections import defaultdict

from splatnode.capture.logged.message import UnusableMessage

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
