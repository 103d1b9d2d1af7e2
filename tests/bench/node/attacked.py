"""Open sockets under attack: malformed messages over ipc, raw bytes on tcp ports, and real peers in between."""

from __future__ import annotations

import contextlib
import random
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zmq

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.messaging import keys
from splatnode.capture.messaging.broadcast import Publisher, Subscriber
from splatnode.capture.messaging.commands import CommandServer
from splatnode.capture.messaging.keyframe_messages import DroppedHeader, FrameHeader, delivered
from splatnode.capture.messaging.keyframes import KeyframeClient, KeyframeServer
from splatnode.capture.messaging.network import Network, runtime_directory
from splatnode.capture.messaging.services import CAPTURE_KEYFRAMES, CAPTURE_PREVIEW, RECON_CONTROL, RECON_SCENE, Service
from splatnode.capture.messaging.spool import Config as SpoolConfig
from splatnode.capture.messaging.spool import Key, Spool
from splatnode.capture.messaging.state import StateClient, StateServer, Want
from splatnode.capture.messaging.wire import Numbering, decode
from splatnode.capture.preview import PreviewHeader
from splatnode.capture.process.memory import resident_mb
from tests.bench.node.malformed import FRAME, IMAGE, Parts, good_messages, malformed

TENTHS = 10
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00"  # ZMTP 3.0 begins so
Serve = Callable[[], None]


def fuzz_sockets(rng: random.Random, count: int) -> dict[str, Any]:
    """Each kind of socket in turn, with a probe after each batch that must get through."""
    goods = [parts for parts, _ in good_messages()]
    memory: list[float] = []
    sent = {"keyframe_server": 0, "state_server": 0, "command_server": 0, "subscriber": 0, "keyframe_client": 0}
    refused = dict.fromkeys(sent, 0)
    with tempfile.TemporaryDirectory() as folder:
        network = Network(directory=Path(folder, "run"))
        spool = Spool(SpoolConfig(Path(folder, "state")))
        with (
            KeyframeServer(network, spool) as keyframes,
            StateServer(RECON_SCENE, network) as scene,
            CommandServer(RECON_CONTROL, network, Want) as control,
            zmq.Context() as context,
        ):
            keyframes.offer(FRAME)
            scene.publish(good_header(), [IMAGE])
            answers: list[Any] = []

            def answer(question: Want) -> Want:
                answers.append(question)
                return question

            servers = {
                "keyframe_server": (CAPTURE_KEYFRAMES, keyframes, lambda: keyframes.serve(0)),
                "state_server": (RECON_SCENE.requests, scene, lambda: scene.serve(0)),
                "command_server": (RECON_CONTROL, control, lambda: control.serve(0, answer)),
            }
            for tenth in range(TENTHS):
                for name, (service, server, serve) in servers.items():
                    batch = count // (5 * TENTHS)
                    throw(rng, context, address(network, service), goods, batch, server, serve)
                    sent[name] += batch
                    refused[name] = server.refused
                for name, receiver in (("subscriber", subscriber_batch), ("keyframe_client", client_batch)):
                    batch = count // (5 * TENTHS)
                    refused[name] += receiver(rng, context, Path(folder, f"{name}{tenth}"), goods, batch)
                    sent[name] += batch
                probe(network, keyframes, scene)
                memory.append(resident_mb())
    return {
        "messages": sum(sent.values()),
        "sent": sent,
        "refused": refused,
        "probes_that_got_through": 2 * TENTHS,
        "rss_mb": memory,
        "growth_mb": memory[-1] - memory[1],
    }


def good_header() -> DroppedHeader:
    return DroppedHeader(**Numbering().next(), name="state", reason="")


def address(network: Network, service: Service) -> str:
    return f"ipc://{runtime_directory(network) / service.name}"


def throw(
    rng: random.Random, context: zmq.Context, where: str, goods: list[Parts], count: int, server: Any, serve: Serve
) -> None:
    """`count` malformed messages through a DEALER; the server reads in between."""
    with connected(context, zmq.DEALER, where) as dealer:
        for index in range(count):
            parts = malformed(rng, rng.choice(goods)) or [b""]
            while True:
                try:
                    dealer.send_multipart(parts, zmq.NOBLOCK)
                    break
                except zmq.Again:
                    serve()
            if index % 50 == 0:
                serve()
                with contextlib.suppress(zmq.Again):
                    while True:
                        dealer.recv_multipart(zmq.NOBLOCK)
        quiet = time.monotonic() + 0.1
        while time.monotonic() < quiet:  # what is on its way arrives
            before = server.refused
            serve()
            quiet = time.monotonic() + 0.1 if server.refused != before else quiet
            time.sleep(0.001)


@contextlib.contextmanager
def connected(context: zmq.Context, kind: int, where: str) -> Iterator[zmq.Socket]:
    with context.socket(kind) as link:
        link.linger = 0
        link.connect(where)
        yield link


def subscriber_batch(rng: random.Random, context: zmq.Context, folder: Path, goods: list[Parts], count: int) -> int:
    """An impostor publishes rubbish on the previews' address."""
    network = Network(directory=folder)
    with context.socket(zmq.PUB) as impostor, Subscriber(CAPTURE_PREVIEW, network, PreviewHeader) as subscriber:
        impostor.linger = 0
        impostor.bind(address(network, CAPTURE_PREVIEW))
        while subscriber.refused == 0:
            impostor.send_multipart([b"rubbish"])
            subscriber.latest(0.01)
        for index in range(count):
            impostor.send_multipart(malformed(rng, goods[2]) or [b""])
            if index % 20 == 0:
                subscriber.latest(0)
        subscriber.latest(0.1)
        return subscriber.refused


def client_batch(rng: random.Random, context: zmq.Context, folder: Path, goods: list[Parts], count: int) -> int:
    """An impostor sends rubbish where keyframes come from."""
    network = Network(directory=folder)
    with context.socket(zmq.ROUTER) as impostor, KeyframeClient(network) as client:
        impostor.linger = 0
        impostor.bind(address(network, CAPTURE_KEYFRAMES))
        while not impostor.poll(10):
            client.receive(0.01)
        identity = impostor.recv_multipart()[0]
        for index in range(count):
            good = rng.choice(goods[:2])
            header = decode(good, FrameHeader | DroppedHeader).header
            frame = delivered(Key(header.session, header.sequence), good)
            impostor.send_multipart([identity, *(malformed(rng, [bytes(part) for part in frame]) or [b""])])
            if index % 4 == 0 and (received := client.receive(0)) is not None:
                client.acknowledge(received)
            if index % 100 == 0:
                with contextlib.suppress(zmq.Again):
                    while True:
                        impostor.recv_multipart(zmq.NOBLOCK)
        while (received := client.receive(0.05)) is not None:
            client.acknowledge(received)
        return client.refused


def probe(network: Network, keyframes: KeyframeServer, scene: StateServer) -> None:
    """Real peers are still served; nobody has taken the keyframe away."""
    deadline = time.monotonic() + 20
    with KeyframeClient(network) as recon, StateClient(RECON_SCENE, network, DroppedHeader) as viewer:
        received = state = None
        while (received is None or state is None) and time.monotonic() < deadline:
            keyframes.serve(0.005)
            scene.serve(0.005)
            received = received or recon.receive(0.005)
            state = state or viewer.poll(0.005)
    if received is None or state is None or received.frame.name != "a.png" or isinstance(received.frame, DroppedFrame):
        raise AssertionError("a real peer is not served any more")


def fuzz_ports(rng: random.Random, connections: int) -> dict[str, Any]:
    """Strangers with raw bytes on every tcp port: none of it may reach the application."""
    with tempfile.TemporaryDirectory() as folder:
        keys.create_keys(Path(folder, "keys"))
        network = Network(directory=Path(folder, "run"), tcp="127.0.0.1", keys=Path(folder, "keys"), first_port=47610)
        spool = Spool(SpoolConfig(Path(folder, "state")))
        with (
            KeyframeServer(network, spool) as keyframes,
            StateServer(RECON_SCENE, network) as scene,
            Publisher(CAPTURE_PREVIEW, network),
        ):
            keyframes.offer(FRAME)
            scene.publish(good_header(), [IMAGE])
            before, sent = resident_mb(), 0
            for index in range(connections):
                port = network.first_port + rng.choice((0, 1, 3, 4))
                sent += shout(rng, port)
                if index % 20 == 0:
                    keyframes.serve(0)
                    scene.serve(0)
            keyframes.serve(0.1)
            scene.serve(0.1)
            reached = keyframes.refused + scene.refused
            probe(network, keyframes, scene)
            return {
                "connections": connections,
                "bytes": sent,
                "messages_that_reached_the_application": reached,
                "growth_mb": resident_mb() - before,
            }


def shout(rng: random.Random, port: int) -> int:
    """A connection with raw bytes: chance, old protocols, HTTP, a greeting with rubbish after it; their number."""
    data = rng.choice(
        (
            rng.randbytes(rng.randrange(1, 3000)),
            b"\x01\x00\x06\x00hello" * 20,
            b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n",
            GREETING + b"NULL" + bytes(16) + b"\x00" + bytes(31) + b"\x04\x19\x05READY" + rng.randbytes(50),
            GREETING + b"CURVE" + bytes(15) + b"\x00" + bytes(31) + rng.randbytes(300),
        )
    )
    with socket.create_connection(("127.0.0.1", port), timeout=5) as stranger, contextlib.suppress(OSError):
        stranger.sendall(data)
        if rng.random() < 0.2:
            stranger.settimeout(0.02)
            stranger.recv(1000)
    return len(data)
