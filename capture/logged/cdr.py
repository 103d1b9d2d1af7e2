"""Values of a ROS 2 message, one after the other.

Source: OMG, DDS Interoperability Wire Protocol (CDR, plain): four bytes that tell the byte order, then values, each
aligned to its size; a text has its length before it and a zero behind it.
"""

from __future__ import annotations

import struct

from splatnode.capture.logged.message import UnusableMessage

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
