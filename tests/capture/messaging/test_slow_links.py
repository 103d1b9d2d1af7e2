"""Over tcp a message takes as long as the link needs: only a link that is dead is given up."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
import zmq

from splatnode.capture.frame import Frame
from splatnode.capture.messaging import network as network_module
from splatnode.capture.messaging.keyframe_queue import KeyframeClient, KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.network import CAPTURE_KEYFRAMES
from tests.capture.messaging.test_sockets import tcp, wait_for
from tests.support.slow_link import THERE, slow_link

IMAGE = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)


@pytest.fixture
def networks(tmp_path, monkeypatch):
    """Of the robot, and of the other end of a link. A link that is dead for a second is given up."""
    monkeypatch.setattr(network_module, "_DEAD_LINK_S", 1)
    here = tcp(tmp_path)
    return here, msgspec.structs.replace(here, directory=tmp_path / "there", tcp=THERE)


def keyframe_server(network, folder) -> KeyframeServer:
    return KeyframeServer(network, Spool(SpoolConfig(folder / "state")))


def exchanged(server, client, until) -> None:
    """Both work as their processes do."""
    ended = threading.Event()

    def receive() -> None:
        while not ended.is_set():
            if (received := client.receive(0.05)) is not None:
                client.acknowledge(received)

    receiving = threading.Thread(target=receive, daemon=True)
    receiving.start()
    try:
        wait_for(lambda: server.serve(0.02) or until(), 20)
    finally:
        ended.set()
        receiving.join()


def test_a_frame_that_takes_longer_than_a_dead_link_arrives_at_once(networks, tmp_path):
    here, there = networks
    port = here.first_port + CAPTURE_KEYFRAMES.tcp_port
    with keyframe_server(here, tmp_path) as server, slow_link([port], bytes_per_s=IMAGE.nbytes / 2.2) as link:
        server.offer(Frame(0, "0.png", 0, IMAGE, None))
        with KeyframeClient(there) as client:
            exchanged(server, client, until=lambda: server.acknowledged == 1)
        assert link.connections == 1 and link.sent < 1.2 * IMAGE.nbytes


@pytest.mark.parametrize("older", ["capture", "recon"])
def test_a_process_of_before_that_sends_heartbeats_is_answered(networks, tmp_path, monkeypatch, older):
    here, there = networks
    port = here.first_port + CAPTURE_KEYFRAMES.tcp_port
    with contextlib.ExitStack() as ends:
        link = ends.enter_context(slow_link([port], bytes_per_s=1e8))
        with of_before(monkeypatch, older == "capture"):
            server = ends.enter_context(keyframe_server(here, tmp_path))
        with of_before(monkeypatch, older == "recon"):
            client = ends.enter_context(KeyframeClient(there))
        quiet_until = time.monotonic() + 0.8  # longer than the heartbeats' time-out
        exchanged(server, client, until=lambda: time.monotonic() > quiet_until)
        server.offer(Frame(0, "0.png", 0, IMAGE, None))
        exchanged(server, client, until=lambda: server.acknowledged == 1)
        assert link.connections == 1


@contextlib.contextmanager
def of_before(monkeypatch, is_older) -> Iterator[None]:
    """What is made in here has heartbeats, as all had, with a shorter time-out."""

    def with_heartbeats(socket: zmq.Socket) -> None:
        socket.heartbeat_ivl, socket.heartbeat_timeout = 50, 250

    with monkeypatch.context() as before:
        if is_older:
            before.setattr(network_module, "_notice_dead_links", with_heartbeats)
        yield
