"""The hostile client of `tests.bench siege`: a process of its own, which does so many bad things a second.

Over ipc it is another process of the same user: it sends what the adversary draws for each socket and what a real
client would say, with the names of sessions that it hears, and it opens connections that say nothing, or rubbish, and
leaves them open. Over tcp it has no key: raw bytes, old protocols, handshakes that stop, and CURVE with its own key.
"""

from __future__ import annotations

import contextlib
import random
import socket
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import yaml
import zmq

from splatnode.capture.messaging.network import (
    CAPTURE_KEYFRAMES,
    CAPTURE_PREVIEW,
    RECON_CONTROL,
    RECON_SCENE,
    RECON_STATUS,
    Network,
    runtime_directory,
)
from splatnode.capture.process.config import parse_config
from tests.bench.node.attacked import shout
from tests.support.adversary.boundaries import BOUNDARIES

REQUESTS = (CAPTURE_KEYFRAMES, RECON_SCENE.requests, RECON_CONTROL)
HEARD = (CAPTURE_PREVIEW, RECON_STATUS, RECON_SCENE)
DRAWS = {each.name: each.draw for each in BOUNDARIES}
OPEN = 200  # connections that are left open at once


def main() -> None:
    network = parse_config(yaml.safe_load(Path(sys.argv[1]).read_text()), Network)
    per_second, rng = float(sys.argv[2]), random.Random(sys.argv[3])
    deeds = over_tcp(rng, network) if network.tcp else over_ipc(rng, network)
    started = time.monotonic()
    for count, _ in enumerate(deeds):
        time.sleep(max(0.0, started + count / per_second - time.monotonic()))


def over_ipc(rng: random.Random, network: Network) -> Iterator[None]:
    """One bad thing a step."""
    addresses = {each: f"ipc://{runtime_directory(network) / each.name}" for each in (*REQUESTS, *HEARD)}
    idle: deque[socket.socket] = deque()
    with zmq.Context() as context:
        links = {each: connected(context, zmq.DEALER, addresses[each]) for each in REQUESTS}
        deaf = [connected(context, zmq.SUB, addresses[each]) for each in HEARD]  # subscribe, and never read
        for link in deaf:
            link.subscribe(b"")
        sessions = Sessions(context, addresses[CAPTURE_PREVIEW])
        while True:
            action = rng.random()
            service = rng.choice(REQUESTS)
            if action < 0.7:
                draw = DRAWS[rng.choice(("keyframe requests", "commands", "states", "recon's heartbeats"))]
                parts = [sessions.put_into(part) for part in draw(rng)] or [b""]
                with contextlib.suppress(zmq.Again):
                    links[service].send_multipart(parts, zmq.NOBLOCK)
            elif action < 0.8:
                links[service].close()
                links[service] = connected(context, zmq.DEALER, addresses[service])
            else:
                path = addresses[rng.choice((*REQUESTS, *HEARD))].removeprefix("ipc://")
                knock(rng, idle, socket.AF_UNIX, path)
            sessions.listen()
            yield


class Sessions:
    """The newest session that the node's previews name, with which messages look like a real client's."""

    def __init__(self, context: zmq.Context, address: str) -> None:
        self._link = connected(context, zmq.SUB, address)
        self._link.subscribe(b"")
        self._newest = b""

    def listen(self) -> None:
        with contextlib.suppress(zmq.Again):
            while True:
                head = self._link.recv_multipart(zmq.NOBLOCK)[1]
                at = head.find(b"session") + len(b"session") + 2
                self._newest = head[at : at + 32]

    def put_into(self, part: bytes) -> bytes:
        at = part.find(b"\xd9 ")  # a text of 32 bytes in MessagePack: a session
        if at < 0 or len(self._newest) != 32:
            return part
        return part[: at + 2] + self._newest + part[at + 34 :]


def over_tcp(rng: random.Random, network: Network) -> Iterator[None]:
    idle: deque[socket.socket] = deque()
    ports = [network.first_port + each.tcp_port for each in (*REQUESTS, *HEARD)]
    with zmq.Context() as context:
        strangers: deque[zmq.Socket] = deque()
        while True:
            action = rng.random()
            port = rng.choice(ports)
            with contextlib.suppress(OSError):
                if action < 0.5:
                    shout(rng, port)
                elif action < 0.8:
                    knock(rng, idle, socket.AF_INET, ("127.0.0.1", port))
                else:
                    strangers.append(stranger(context, f"tcp://127.0.0.1:{port}", network))
                    if len(strangers) > OPEN // 10:
                        strangers.popleft().close()
            yield


def stranger(context: zmq.Context, address: str, network: Network) -> zmq.Socket:
    """A client with keys of its own, which knows the server's public key."""
    link = context.socket(zmq.DEALER)
    link.linger = 0
    link.curve_publickey, link.curve_secretkey = zmq.curve_keypair()
    link.curve_serverkey = (network.keys or Path()).joinpath("public.key").read_bytes().strip()
    link.connect(address)
    link.send_multipart([b"hello"])
    return link


def connected(context: zmq.Context, kind: int, address: str) -> zmq.Socket:
    link = context.socket(kind)
    link.linger = 0
    link.sndhwm = 100
    link.connect(address)
    return link


def knock(rng: random.Random, idle: deque[socket.socket], family: int, address: object) -> None:
    """A connection with a few bytes or none, which stays open; the oldest is closed."""
    link = socket.socket(family, socket.SOCK_STREAM)
    link.settimeout(0.05)
    idle.append(link)
    with contextlib.suppress(OSError):
        link.connect(address)  # pyright: ignore[reportArgumentType]
        link.send(rng.randbytes(rng.choice((1, 10, 64, 3000))))
    if len(idle) > OPEN:
        idle.popleft().close()


if __name__ == "__main__":
    main()
