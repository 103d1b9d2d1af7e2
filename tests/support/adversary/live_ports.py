"""The boundaries of open sockets: a stranger of the same user sends to each port, over ipc, what he likes.

Sockets are opened once in a process, in a folder beside those of the cases. A message is sent and read before the next
one, so that a defect is the fault of that message.
"""

from __future__ import annotations

import contextlib
import functools
import random
import socket
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import zmq

from splatnode.capture.config import PreviewHeader
from splatnode.capture.messaging import network
from splatnode.capture.messaging.keyframe_queue import KeyframeClient, KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.messages import MAGIC, Delivery, FrameHeader, Request, plain_header
from splatnode.capture.messaging.network import (
    CAPTURE_KEYFRAMES,
    CAPTURE_PREVIEW,
    CAPTURE_STATUS,
    RECON_CONTROL,
    RECON_SCENE,
    Network,
    Service,
    runtime_directory,
)
from splatnode.capture.messaging.pubsub import Answer, CommandServer, StateClient, StateServer, Subscriber, Want
from splatnode.capture.status import CaptureStatus, _Listener
from splatnode.recon.daemon.node import Command
from splatnode.recon.result.message import SceneHeader
from tests.bench.node.attacked import shout
from tests.support.adversary import images, messages
from tests.support.adversary.boundary import Boundary, Reader
from tests.support.adversary.documents_read import Refused

_PATIENCE_S = 0.5  # for a message on its way within this process


class _Port:
    """An end of ours and the stranger who sends to it."""

    def __init__(self, kind: str) -> None:
        # Kept until the process ends: sockets of a process that goes on are never taken down.
        self._folder = tempfile.mkdtemp(prefix="ports-", dir=tempfile.gettempdir())
        self._network = Network(directory=Path(self._folder, "run"))
        self._context = zmq.Context()
        self.ours, self._take, self._stranger, self._identity = getattr(self, f"_open_{kind}")()
        self._heard = 0

    def send(self, parts: messages.Parts) -> int:
        """Sends a message, lets our end read it, and returns how many it has refused since the last call."""
        whole = [*self._identity, *(parts or [b""])]
        with contextlib.suppress(zmq.Again):
            self._stranger.send_multipart(whole, zmq.NOBLOCK)
        self._take()
        with contextlib.suppress(zmq.Again):
            for _ in range(50):
                self._stranger.recv_multipart(zmq.NOBLOCK)
        refused, self._heard = self.ours.refused - self._heard, self.ours.refused
        return refused

    def _where(self, service: Service) -> str:
        return f"ipc://{runtime_directory(self._network) / service.name}"

    def _socket(self, kind: int) -> zmq.Socket:
        link = self._context.socket(kind)
        link.linger, link.rcvhwm = 0, 100
        return link

    def _dealer(self, service: Service) -> zmq.Socket:
        dealer = self._socket(zmq.DEALER)
        dealer.connect(self._where(service))
        return dealer

    def _open_keyframes(self) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        from tests.bench.node.malformed import FRAME

        server = KeyframeServer(self._network, Spool(SpoolConfig(Path(self._folder, "state"))))
        server.offer(FRAME)
        return server, lambda: server.serve(_PATIENCE_S), self._dealer(CAPTURE_KEYFRAMES), []

    def _open_states(self) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        server = StateServer(RECON_SCENE, self._network)
        return server, lambda: server.serve(_PATIENCE_S), self._dealer(RECON_SCENE.requests), []

    def _open_commands(self) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        server = CommandServer(RECON_CONTROL, self._network, Command)
        reply = Answer(True, "done")
        return server, lambda: server.serve(_PATIENCE_S, lambda _: reply), self._dealer(RECON_CONTROL), []

    def _open_strangers(self) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        """Over tcp with keys: of what a stranger without one sends, nothing may reach the application."""
        from tests.bench.node.malformed import FRAME

        network.create_keys(Path(self._folder, "keys"))
        whole = {"tcp": "127.0.0.1", "keys": Path(self._folder, "keys"), "first_port": _free_port()}
        self._network = Network(directory=Path(self._folder, "run"), **whole)
        server = KeyframeServer(self._network, Spool(SpoolConfig(Path(self._folder, "state"))))
        server.offer(FRAME)
        return server, lambda: server.serve(0.0), self._socket(zmq.DEALER), []

    def shout(self, rng: random.Random) -> None:
        """A connection of its own. Raises AssertionError where something of it reached the application."""
        shout(rng, self._network.first_port)
        self._take()
        if self.ours.refused:
            raise AssertionError(f"reached the application: {self.ours.why_refused}")

    def _publisher(self, service: Service) -> zmq.Socket:
        runtime_directory(self._network).mkdir(mode=0o700, parents=True, exist_ok=True)
        publisher = self._socket(zmq.XPUB)
        publisher.bind(self._where(service))
        return publisher

    def _subscribed(
        self, service: Service, opened: Callable[[], Subscriber]
    ) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        publisher = self._publisher(service)
        subscriber = opened()
        for _ in range(1000):  # until the subscription has arrived
            subscriber.latest(0.005)
            if publisher.poll(5):
                break
        return subscriber, lambda: self._hear(subscriber), publisher, []

    def _hear(self, subscriber: Subscriber) -> None:
        if subscriber._socket_in.poll(int(1000 * _PATIENCE_S)):
            subscriber.latest(0.0)

    def _open_previews(self) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        return self._subscribed(CAPTURE_PREVIEW, lambda: Subscriber(CAPTURE_PREVIEW, self._network, PreviewHeader))

    def _open_heartbeats(self) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        return self._subscribed(CAPTURE_STATUS, lambda: _Listener(CAPTURE_STATUS, self._network))

    def _open_scenes(self) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        publisher = self._publisher(RECON_SCENE)
        client = StateClient(RECON_SCENE, self._network, SceneHeader)
        for _ in range(1000):
            client.poll(0.005)
            if publisher.poll(5):
                break

        def hear() -> None:
            if client._subscriber.poll(int(1000 * _PATIENCE_S)):
                client.poll(0.0)

        return client, hear, publisher, []

    def _open_deliveries(self) -> tuple[Any, Callable[[], Any], zmq.Socket, list[bytes]]:
        runtime_directory(self._network).mkdir(mode=0o700, parents=True, exist_ok=True)
        router = self._socket(zmq.ROUTER)
        router.bind(self._where(CAPTURE_KEYFRAMES))
        client = KeyframeClient(self._network)
        while not router.poll(10):
            client.receive(0.01)
        identity = router.recv_multipart()[0]

        def take() -> None:
            if client._dealer.poll(int(1000 * _PATIENCE_S)):
                received = client.receive(0.0)
                if received is not None:
                    client.acknowledge(received)

        return client, take, router, [identity]


@functools.lru_cache(maxsize=16)
def _port(kind: str) -> _Port:
    return _Port(kind)


def _sending(kind: str) -> Callable[[messages.Parts, Path], object]:
    def read(parts: messages.Parts, folder: Path) -> object:
        if _port(kind).send(parts):
            raise Refused("counted as refused")
        return None

    return read


def _shout(seed: bytes, folder: Path) -> None:
    _port("strangers").shout(random.Random(seed))


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def _delivery(rng: random.Random) -> messages.Parts:
    """A keyframe and the delivery before it, which is mostly its own."""
    frame = messages.message(rng, FrameHeader, messages.frame_rows)
    head = plain_header(frame)
    if rng.random() < 0.9 and {"session", "sequence"} <= set(head):
        numbers = {"type": "delivery", "session": head["session"], "sequence": head["sequence"]}
        before = [MAGIC, msgspec.msgpack.encode([numbers, []])]
    else:
        before = messages.message(rng, Delivery)
    return [*before, *frame]


def _of(schema: Any, table: Any = lambda rng, header: ()) -> Callable[[random.Random], messages.Parts]:
    return lambda rng: messages.message(rng, schema, table)


def _preview(rng: random.Random, header: Any) -> list[messages.Row]:
    return [messages.bytes_row(images.sound(".jpg"))]


def _gaussians(rng: random.Random, header: Any) -> list[messages.Row]:
    return messages.gaussian_rows(rng)


_MESSAGING = "splatnode.capture.messaging"


def _reader(name: str) -> Reader:
    return Reader((Refused,), (f"{_MESSAGING}.{name}",))


PORTS = (
    Boundary(
        "port: keyframes", _of(Request), _sending("keyframes"), _reader("keyframes"), 50, 0.5, mutants=4, tidy=False
    ),
    Boundary("port: strangers", lambda rng: rng.randbytes(8), _shout, _reader("network"), 50, 0.05, tidy=False),
    Boundary("port: states", _of(Want), _sending("states"), _reader("state"), 50, 0.3, mutants=4, tidy=False),
    Boundary("port: commands", _of(Command), _sending("commands"), _reader("commands"), 50, 0.3, mutants=4, tidy=False),
    Boundary(
        "port: previews",
        _of(PreviewHeader, _preview),
        _sending("previews"),
        _reader("broadcast"),
        50,
        0.3,
        mutants=4,
        tidy=False,
    ),
    Boundary(
        "port: heartbeats",
        _of(CaptureStatus),
        _sending("heartbeats"),
        _reader("broadcast"),
        50,
        0.3,
        mutants=4,
        tidy=False,
    ),
    Boundary(
        "port: scenes",
        _of(SceneHeader, _gaussians),
        _sending("scenes"),
        _reader("state"),
        50,
        0.3,
        mutants=4,
        tidy=False,
    ),
    Boundary(
        "port: deliveries", _delivery, _sending("deliveries"), _reader("keyframes"), 50, 0.5, mutants=4, tidy=False
    ),
)
