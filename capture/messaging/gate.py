"""Bounds the connections of those without a key, which libzmq accepts without end, each with one of our descriptors.

libzmq tells of each connection that it accepts, and closes it five seconds later where its handshake has not come to
its end. Meanwhile a stranger can open any number. So many may be in their handshake here; for each further one the
oldest is shut, of the address that has the most. Who has a key is let in within a few round trips, is no more among
those, and shares the places with nobody of another address.

Which of them are let in, libzmq does not tell; the kernel does, by the bytes that it has sent over a connection: READY,
which a server says to a key that it knows, is beyond what it says to anybody (ZeroMQ RFC 23 and 26).
"""

from __future__ import annotations

import contextlib
import logging
import socket
import struct
import threading
from collections.abc import Iterator
from typing import NamedTuple

import zmq
from zmq.utils.monitor import recv_monitor_message

from splatnode.capture.process.crowd import network_of, next_to_go
from splatnode.capture.process.logs import is_logged

log = logging.getLogger(__name__)

PLACES = 32  # of a socket, for connections in their handshake
OVERSHOOT = 128  # of a process: connections that libzmq may accept before the gate has seen the first of them
_EVENTS = zmq.EVENT_ACCEPTED | zmq.EVENT_ACCEPT_FAILED | zmq.EVENT_DISCONNECTED | zmq.EVENT_MONITOR_STOPPED
_SAID_TO_ANYBODY = 64 + 170 + 14  # bytes: greeting, WELCOME, ERROR 400
_INFO_BYTES, _ACKED = 256, struct.Struct("120xQ")  # tcp_info of linux/tcp.h, with tcpi_bytes_acked, since Linux 4.1
_CLOSE_S = 5.0


class _Peer(NamedTuple):
    network: str
    port: int


class Gate:
    """Watches a bound TCP socket in a thread of its own, which needs no descriptor and no memory to speak of."""

    def __init__(self, bound: zmq.Socket, places: int = PLACES) -> None:
        self.shut = 0  # connections
        self._socket, self._places = bound, places
        self._monitor = bound.get_monitor_socket(_EVENTS)
        self._young: dict[int, _Peer] = {}  # by descriptor, the oldest first; some of them are let in already
        self._thread = threading.Thread(target=self._watch, name="gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """To be called while the socket is open."""
        self._socket.disable_monitor()
        self._thread.join(_CLOSE_S)

    def _watch(self) -> None:
        with self._monitor:
            while (event := recv_monitor_message(self._monitor))["event"] != zmq.EVENT_MONITOR_STOPPED:
                self._note(event["event"], event["value"])

    def _note(self, event: int, descriptor: int) -> None:
        if event == zmq.EVENT_ACCEPT_FAILED:  # no descriptor is free
            self._keep(self._places // 2)
            return
        self._young.pop(descriptor, None)
        if event == zmq.EVENT_ACCEPTED:
            peer = _peer(descriptor)
            if peer is not None:
                self._young[descriptor] = peer
            self._keep(self._places)

    def _keep(self, most: int) -> None:
        """Lets at most so many be in their handshake."""
        if len(self._young) <= most:
            return
        for descriptor in [each for each in self._young if _is_let_in(each)]:
            del self._young[descriptor]
        while len(self._young) > most:
            self._shut(next_to_go({each: peer.network for each, peer in self._young.items()}))

    def _shut(self, descriptor: int) -> None:
        """Leaves alone what is no connection of this peer any more; libzmq closes the others."""
        peer = self._young.pop(descriptor)
        if _peer(descriptor) != peer:
            return
        with _lent(descriptor) as connection, contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        self.shut += 1
        if is_logged(self.shut):
            log.warning("too many connections without a key: shut one of %s (%d so far)", peer.network, self.shut)


@contextlib.contextmanager
def _lent(descriptor: int) -> Iterator[socket.socket]:
    """A socket of libzmq's, as one of Python's that does not close it."""
    connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, descriptor)
    try:
        yield connection
    finally:
        connection.detach()


def _peer(descriptor: int) -> _Peer | None:
    """Who is connected; None where the connection has ended meanwhile."""
    try:
        with _lent(descriptor) as connection:
            host, port = connection.getpeername()[:2]
            return _Peer(network_of(host), port)
    except (OSError, ValueError):
        return None


def _is_let_in(descriptor: int) -> bool:
    try:
        with _lent(descriptor) as connection:
            told = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
    except OSError:
        return False
    return len(told) >= _ACKED.size and _ACKED.unpack_from(told)[0] > _SAID_TO_ANYBODY
