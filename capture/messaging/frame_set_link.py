"""Between the captures of one machine: at which times each took a keyframe, so that the others take theirs.

And that one has no room: the others keep no part of a frame set then.

Datagrams in the private folder of the sockets, also where keyframes go over tcp. Nobody waits for one, and one that is
lost costs a frame set an image.
"""

from __future__ import annotations

import contextlib
import logging
import math
import socket
import struct
import time
from pathlib import Path

from splatnode.capture.frame import LARGEST_NS, Clock, Stamp
from splatnode.capture.messaging.network import Network, runtime_directory

log = logging.getLogger(__name__)

_NAME = "capture.together@"  # begins the names of the sockets
_LAYOUT = struct.Struct("<4sBq")  # mark, clock by its place in Clock, nanoseconds
_TAKEN, _FULL = b"SET1", b"FUL1"
FULL_S = 2.0  # for which the word of one that has no room counts; it says so again and again
_CLOCKS = tuple(Clock)
_MOST_RECEIVED = 100  # datagrams at a time


class FrameSetLink:
    """One capture's end, for a capture with a camera id. Close it, or use it as a context manager."""

    def __init__(self, network: Network, camera_id: str) -> None:
        """To be made by the one process that offers this camera's keyframes. Raises NetworkError, OSError."""
        self._path = runtime_directory(network) / f"{_NAME}{camera_id}"
        self._full_s = -math.inf  # when another said last that it has no room (monotonic)
        self._path.unlink(missing_ok=True)  # of a process that was killed
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind(str(self._path))
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> FrameSetLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def announce(self, stamp: Stamp) -> None:
        """Tells the others that a keyframe was taken then. One that does not listen, or not now, is left out."""
        self._send(_TAKEN, _CLOCKS.index(stamp.clock), stamp.ns)

    def announce_full(self) -> None:
        """Tells the others that there is no room for this camera's keyframes."""
        self._send(_FULL, 0, 0)

    def _send(self, mark: bytes, clock: int, ns: int) -> None:
        message = _LAYOUT.pack(mark, clock, ns)
        for path in self._list_others():
            with contextlib.suppress(OSError):
                self._socket.sendto(message, str(path))

    def receive(self) -> list[Stamp]:
        """The times at which others took keyframes since the last call."""
        found = []
        for _ in range(_MOST_RECEIVED):
            try:
                data = self._socket.recv(_LAYOUT.size + 1)
            except OSError:
                break
            if data == _LAYOUT.pack(_FULL, 0, 0):
                self._full_s = time.monotonic()
            elif (stamp := _parse(data)) is not None:
                found.append(stamp)
        return found

    @property
    def is_another_full(self) -> bool:
        """Whether another has no room, by what was received."""
        return time.monotonic() - self._full_s < FULL_S

    def _list_others(self) -> list[Path]:
        return [path for path in self._path.parent.glob(f"{_NAME}*") if path != self._path and path.is_socket()]


def _parse(data: bytes) -> Stamp | None:
    """None for what no capture of this version sends."""
    if len(data) != _LAYOUT.size:
        return None
    mark, clock, ns = _LAYOUT.unpack(data)
    is_known = mark == _TAKEN and clock < len(_CLOCKS) and 0 <= ns <= LARGEST_NS
    return Stamp(ns, _CLOCKS[clock]) if is_known else None
