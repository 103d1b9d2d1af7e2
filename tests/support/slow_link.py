"""A link to the ports of a server on this machine that is as slow as one likes: relays on another loopback address."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

THERE, HERE = "127.0.0.2", "127.0.0.1"  # where clients connect, and where the server listens
PIECE = 4096  # bytes that are handed on at once


@dataclass
class Link:
    """What has gone over it."""

    connections: int = 0
    sent: int = 0  # bytes, to the clients


@contextlib.contextmanager
def slow_link(ports: Iterable[int], bytes_per_s: float) -> Iterator[Link]:
    """What a server sends takes its time; what clients send does not."""
    link, ended = Link(), threading.Event()
    with contextlib.ExitStack() as resources:
        resources.callback(ended.set)
        for port in ports:
            listening = resources.enter_context(socket.create_server((THERE, port)))
            resources.callback(listening.shutdown, socket.SHUT_RDWR)  # wakes who accepts
            accepting = threading.Thread(target=_accept, args=(listening, port, bytes_per_s, link, ended), daemon=True)
            accepting.start()
        yield link


def _accept(listening: socket.socket, port: int, bytes_per_s: float, link: Link, ended: threading.Event) -> None:
    with contextlib.suppress(OSError):  # the link has ended
        while True:
            client, _ = listening.accept()
            link.connections += 1
            server = socket.create_connection((HERE, port))
            for pump in (_hand_on, _hand_on_slowly):
                args = (client, server) if pump is _hand_on else (server, client, bytes_per_s, link, ended)
                threading.Thread(target=pump, args=args, daemon=True).start()


def _hand_on(source: socket.socket, target: socket.socket) -> None:
    with contextlib.suppress(OSError), source, target:
        while data := source.recv(PIECE):
            target.sendall(data)


def _hand_on_slowly(
    source: socket.socket, target: socket.socket, bytes_per_s: float, link: Link, ended: threading.Event
) -> None:
    with contextlib.suppress(OSError), source, target:
        while (data := source.recv(PIECE)) and not ended.is_set():
            time.sleep(len(data) / bytes_per_s)
            target.sendall(data)
            link.sent += len(data)
