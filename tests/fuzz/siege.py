"""Strangers before a robot's ports: `python -m tests.fuzz.siege SECONDS [SEED]`, or `main` in a nightly run.

`splatnode capture` (and in the long form `splatnode recon`) work over tcp with few descriptors; a web viewer serves
beside them. Strangers without a key open connections and leave them open: silent, with rubbish, with the first half of
a CURVE handshake, with a whole one of a wrong key, slow HTTP. Somebody with the key comes anew all the time and must be
served: heartbeats, keyframes, the page. Loopback alone.
"""

from __future__ import annotations

import contextlib
import http.client
import itertools
import json
import random
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zmq

from splatnode.capture.messaging.keyframe_queue import KeyframeClient
from splatnode.capture.messaging.network import (
    CAPTURE_CONTROL,
    CAPTURE_KEYFRAMES,
    CAPTURE_PREVIEW,
    CAPTURE_STATUS,
    RECON_CONTROL,
    RECON_SCENE,
    RECON_STATUS,
    Network,
    create_keys,
)
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.status import CaptureStatus
from splatnode.recon.daemon import ReconStatus
from tests.capture.messaging.test_sockets import free_ports
from tests.support.node import Node, descriptors, running
from tests.viewer.web.test_server import KEY, scene, shown

LONGEST_SILENCE_S = 10.0  # for who has the key, on a busy machine
LOOPS = 100_000  # of the photographs, of which each is a keyframe once: capture goes on as a camera does
GREETING = b"\xff" + bytes(7) + b"\x01\x7f\x03\x00CURVE" + bytes(15 + 1 + 31)
HELLO = b"\x04\xc8\x05HELLO\x01\x00" + bytes(72 + 32 + 8 + 80)
_PICTURE = (240, 320, 3)
_LIMITED = ("sh", "-c", 'ulimit -n "$0"; exec "$@"')
_CAPTURES = (CAPTURE_KEYFRAMES, CAPTURE_PREVIEW, CAPTURE_STATUS, CAPTURE_CONTROL)
_HEARTBEATS = {"capture": (CAPTURE_STATUS, CaptureStatus), "recon": (RECON_STATUS, ReconStatus)}
_RECONS = (RECON_SCENE, RECON_SCENE.requests, RECON_STATUS, RECON_CONTROL)


@dataclass(frozen=True)
class Force:
    """What comes against the node, and what the node has."""

    strangers: int = 1000  # connections that are open at once, at each process
    per_second: float = 400.0  # new ones
    files: int = 1024  # that a process of the node may open, at most
    photographs: int = 40
    with_recon: bool = True


@dataclass
class _Found:
    counts: Counter[str] = field(default_factory=Counter)
    defects: list[str] = field(default_factory=list)

    def expect(self, condition: object, otherwise: str) -> None:
        if not condition and otherwise not in self.defects:
            self.defects.append(otherwise)


def main(seconds: float, seed: int) -> dict[str, Any]:
    """Besieges a node; what happened, by kind, and what should not have, in sentences."""
    return besiege(seconds, seed, Force())


def besiege(seconds: float, seed: int, force: Force) -> dict[str, Any]:
    found, rng = _Found(), random.Random(seed)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        place = Path(folder)
        node = stack.enter_context(running(_node(place, force)))
        for verb in ("capture", "recon") if force.with_recon else ("capture",):
            node.start(verb, before=(*_LIMITED, str(force.files)))
        _served(node, found, time.monotonic() + 120)
        server = stack.enter_context(shown(scene(), KEY))
        services = _CAPTURES + (_RECONS if force.with_recon else ())
        ports = [node.network.first_port + each.tcp_port for each in services]
        strangers = _Strangers(rng, [*ports, server.server_address[1]], force, node.network, len(services) / 4)
        stack.enter_context(strangers)
        found.expect(strangers.are_here.wait(60), "the strangers did not come within 60 s")
        until = time.monotonic() + seconds
        with KeyframeClient(node.network) if not force.with_recon else contextlib.nullcontext() as client:
            taken = set[str]()
            while time.monotonic() < until or (client and len(taken) < force.photographs):
                _served(node, found, time.monotonic() + LONGEST_SILENCE_S)
                _page(server.server_address[:2], found)
                _look_at(node, found, force)
                _take(client, taken)
                _look_at(node, found, force)
                if found.defects or time.monotonic() > until + 60:
                    break
            if client:
                found.expect(len(taken) == force.photographs, f"{len(taken)} of {force.photographs} keyframes came")
        found.counts.update(strangers.counts)
        found.counts["keyframes taken"] = len(taken)
        if found.defects:
            found.defects.append(node.log("capture")[-2000:])
    return {"seconds": seconds, "seed": seed, "counts": dict(found.counts), "defects": found.defects}


def _node(place: Path, force: Force) -> Node:
    pictures = place / "photographs"
    pictures.mkdir()
    for index in range(force.photographs):
        noise = np.random.default_rng(index).integers(0, 256, (30, 40, 3)).astype(np.uint8)
        image = cv2.resize(noise, _PICTURE[1::-1], interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(pictures / f"{index:03d}.png"), image)
    create_keys(place / "keys")
    network = {"tcp": "127.0.0.1", "keys": str(place / "keys"), "first_port": free_ports(12)}
    folder = {"kind": "folder", "folder": str(pictures), "fps": 8.0, "pace": "recorded", "loops": LOOPS}
    camera = {"camera": folder, "selection": {"every_frame": True}}
    return Node(place / "node", camera, {"tracking": {"interval_s": 0}}, network)


def _served(node: Node, found: _Found, until: float) -> None:
    """Somebody with the key comes and hears both heartbeats."""
    rooms = set(node.processes)
    while rooms and time.monotonic() < until:
        for name in node.processes:
            if node.processes[name].poll() is not None:
                found.expect(False, f"{name} ended with {node.processes[name].poll()}")
                return
        for room in tuple(rooms):
            service, schema = _HEARTBEATS[room]
            with Subscriber(service, node.network, schema) as heart:
                if heart.latest(2.0) is not None:
                    rooms.remove(room)
                    found.counts["heartbeats heard"] += 1
    found.expect(not rooms, f"{', '.join(sorted(rooms))} did not answer who has the key within {LONGEST_SILENCE_S} s")


def _page(address: tuple[str, int], found: _Found) -> None:
    connection = http.client.HTTPConnection(*address, timeout=LONGEST_SILENCE_S)
    with contextlib.closing(connection):
        try:
            connection.request("GET", "/told", headers={"Authorization": f"Bearer {KEY}"})
            status = connection.getresponse().status
        except (OSError, http.client.HTTPException) as error:
            found.counts["pages tried again"] += 1
            status = 0 if found.counts["pages tried again"] % 5 else str(error)
    found.counts["pages given"] += status == 200
    found.expect(status in (0, 200), f"the page answered {status} to who has the key")


def _take(client: KeyframeClient | None, taken: set[str]) -> None:
    until = time.monotonic() + 0.3
    while client is not None and time.monotonic() < until:
        if (received := client.receive(0.05)) is not None:
            taken.add(received.frame.name)
            client.acknowledge(received)


def _look_at(node: Node, found: _Found, force: Force) -> None:
    for name, process in node.processes.items():
        with contextlib.suppress(OSError):
            open_now = descriptors(process.pid)
            key = f"most descriptors of {name}"
            found.counts[key] = max(found.counts[key], open_now)
            found.expect(open_now < force.files, f"{name} had all of its {force.files} descriptors open")


class _Strangers:
    """Threads would cost those who are besieged their processor: one does it all."""

    def __init__(self, rng: random.Random, ports: list[int], force: Force, network: Network, processes: float) -> None:
        self.counts: Counter[str] = Counter()
        self._rng, self._ports, self._force, self._network = rng, ports, force, network
        self._most = round(force.strangers * processes)
        self.are_here = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> _Strangers:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(30)

    def _run(self) -> None:
        began, links = time.monotonic(), list[socket.socket]()
        with zmq.Context() as context, contextlib.ExitStack() as stack:
            stack.callback(lambda: [link.close() for link in links])
            for count in itertools.count():
                if self._stop.wait(max(0.0, began + (count - self._most) / self._force.per_second - time.monotonic())):
                    return  # the first come all at once
                with contextlib.suppress(OSError):
                    self._knock(links, context)
                if len(links) > self._most or count > 2 * self._most:
                    self.are_here.set()
                if len(links) > self._most:
                    links.pop(self._rng.randrange(len(links))).close()

    def _knock(self, links: list[socket.socket], context: zmq.Context) -> None:
        port = self._rng.choice(self._ports)
        what = self._rng.random()
        if what < 0.02:
            self.counts["with a wrong key"] += 1
            _with_a_wrong_key(context, port, self._network)
            return
        link = socket.create_connection(("127.0.0.1", port), timeout=1.0)
        links.append(link)
        said, kind = b"", "silent"
        if what > 0.9:
            said, kind = self._rng.randbytes(self._rng.choice((1, 10, 64, 3000))), "rubbish"
        elif what > 0.8:
            said, kind = GREETING[: self._rng.randrange(1, 64)], "half greetings"
        elif what > 0.7:
            said, kind = GREETING + HELLO[: self._rng.choice((1, 100, 202))], "half handshakes"
        elif what > 0.65:
            said, kind = b"GET / HTTP/1.1\r\nHost: ", "half requests"
        self.counts[kind] += 1
        link.sendall(said)


def _with_a_wrong_key(context: zmq.Context, port: int, network: Network) -> None:
    """A handshake of a key that nobody allowed, in the time that the others leave it."""
    link = context.socket(zmq.DEALER)
    link.linger = 0
    link.curve_publickey, link.curve_secretkey = zmq.curve_keypair()
    link.curve_serverkey = (network.keys or Path()).joinpath("public.key").read_bytes().strip()
    link.connect(f"tcp://127.0.0.1:{port}")
    link.poll(20)
    link.close()


if __name__ == "__main__":
    print(json.dumps(main(float(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0), indent=1))
