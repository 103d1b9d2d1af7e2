"""Connections without a key are bounded, whoever opens them, and cost those who have the key nothing."""

from __future__ import annotations

import contextlib
import os
import socket

import pytest
import zmq

from splatnode.capture.messaging import network as network_module
from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, PLACES, Gate, files_for_strangers
from splatnode.capture.messaging.pubsub import Publisher, Subscriber
from splatnode.capture.process.system import LimitTooLow, network_of, next_to_go
from tests.capture.messaging.test_sockets import Note, heard, ipc, tcp, wait_for
from tests.fuzz.siege import GREETING, HELLO
from tests.support.node import descriptors


@pytest.fixture
def crowd():
    """Opens connections, which stay open until the test ends."""
    with contextlib.ExitStack() as stack:

        def come(network, number, said=b""):
            port = network.first_port + CAPTURE_PREVIEW.tcp_port
            for _ in range(number):
                link = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
                link.sendall(said)

        yield come


@pytest.mark.parametrize(
    "said", [b"", GREETING[:20], GREETING, GREETING + HELLO], ids=["", "half", "greeting", "hello"]
)
def test_a_crowd_has_few_places_and_who_has_the_key_is_let_in(tmp_path, crowd, said):
    network, numbering = tcp(tmp_path), Numbering()
    with Publisher(CAPTURE_PREVIEW, network) as publisher, Subscriber(CAPTURE_PREVIEW, network, Note) as early:
        heard(publisher, early, numbering)
        before = descriptors(os.getpid())
        crowd(network, 3 * PLACES, said)
        with Subscriber(CAPTURE_PREVIEW, network, Note) as late:
            heard(publisher, late, numbering)
            # The crowd's own ends are in this process, too.
            wait_for(lambda: descriptors(os.getpid()) < before + 4 * PLACES + 40, 4.0)
        heard(publisher, early, numbering)
        assert early.lost == 0  # its connection has not been shut


def test_many_who_have_the_key_are_no_crowd(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(network_module, "Gate", lambda bound: Gate(bound, 3))
    network, numbering = tcp(tmp_path), Numbering()
    with contextlib.ExitStack() as stack:
        publisher = stack.enter_context(Publisher(CAPTURE_PREVIEW, network))
        for _ in range(12):
            heard(publisher, stack.enter_context(Subscriber(CAPTURE_PREVIEW, network, Note)), numbering)
    assert "too many" not in caplog.text


def test_a_wrong_key_is_no_key(tmp_path, monkeypatch):
    monkeypatch.setattr(network_module, "Gate", lambda bound: Gate(bound, 2))
    network, numbering = tcp(tmp_path), Numbering()
    with contextlib.ExitStack() as stack, Publisher(CAPTURE_PREVIEW, network) as publisher:
        context = stack.enter_context(zmq.Context())
        for _ in range(12):
            link = stack.enter_context(context.socket(zmq.SUB))
            link.linger, link.curve_serverkey = 0, (network.keys / "public.key").read_bytes().strip()
            link.curve_publickey, link.curve_secretkey = zmq.curve_keypair()
            link.connect(f"tcp://127.0.0.1:{network.first_port + CAPTURE_PREVIEW.tcp_port}")
        with Subscriber(CAPTURE_PREVIEW, network, Note) as subscriber:
            heard(publisher, subscriber, numbering)


def test_one_machines_crowd_takes_no_place_of_another():
    assert next_to_go({1: "a", 2: "b", 3: "b", 4: "a", 5: "b"}) == 2
    assert next_to_go({1: "a"}) == 1
    assert network_of("192.0.2.7") == network_of("::ffff:192.0.2.7") == "192.0.2.7"
    assert network_of("2001:db8::1") == network_of("2001:db8::ffff:1") != network_of("2001:db8:0:1::1")
    assert network_of("fe80::1%eth0") == network_of("fe80::2")


def test_what_strangers_may_take_is_left_free_or_the_start_is_refused(tmp_path, monkeypatch):
    assert files_for_strangers(ipc(tmp_path), 4) == 0
    needed = files_for_strangers(tcp(tmp_path), 4)
    assert needed >= 4 * PLACES
    with pytest.raises(LimitTooLow, match="ulimit -n"):
        monkeypatch.setattr("splatnode.capture.process.system.resource.getrlimit", lambda _: (needed, needed))
        network_module.make_sure_of_room(needed, 0)
