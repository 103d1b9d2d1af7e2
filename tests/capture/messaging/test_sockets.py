"""Sockets over ipc and over tcp with CURVE: who comes late, comes twice or speaks rubbish."""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import msgspec
import numpy as np
import pytest
import zmq

from splatnode.capture.messaging import network as keys
from splatnode.capture.messaging.messages import Header, Numbering
from splatnode.capture.messaging.network import (
    CAPTURE_PREVIEW,
    RECON_CONTROL,
    RECON_SCENE,
    AlreadyRunning,
    Network,
    runtime_directory,
)
from splatnode.capture.messaging.pubsub import (
    CommandServer,
    NoAnswer,
    Publisher,
    StateClient,
    StateServer,
    Subscriber,
    ask,
)
from tests.conftest import ROOT


class Note(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    text: str = ""


def free_ports(count=8):
    """The first of `count` ports that were free just now, below those that the system gives to connections."""
    for first in range(20000 + os.getpid() % 1000 * count, 32000, count):
        try:
            for port in range(first, first + count):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
            return first
        except OSError:
            continue
    raise AssertionError("no free ports")


def ipc(folder):
    return Network(directory=folder / "run")


def tcp(folder):
    keys.create_keys(folder / "keys")
    return Network(directory=folder / "run", tcp="127.0.0.1", keys=folder / "keys", first_port=free_ports())


@pytest.fixture(params=[ipc, tcp], ids=["ipc", "tcp+curve"])
def network(request, tmp_path):
    return request.param(tmp_path)


def wait_for(what, seconds=60.0):
    """The first true result of `what`."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        result = what()
        if result:
            return result
    raise AssertionError(f"did not happen within {seconds} s")


def heard(publisher, subscriber, numbering):
    """Publishes until the subscriber hears it."""

    def once():
        publisher.send(Note(**numbering.next()))
        return subscriber.latest(0.05)

    return wait_for(once)


def test_broadcast_whoever_starts_first(network):
    image = np.arange(300_000, dtype=np.uint8)
    numbering = Numbering()
    with Subscriber(CAPTURE_PREVIEW, network, Note) as early, Publisher(CAPTURE_PREVIEW, network) as publisher:
        assert early.latest(0) is None and early.age_s == float("inf")
        with Subscriber(CAPTURE_PREVIEW, network, Note) as late:
            heard(publisher, early, numbering)
            heard(publisher, late, numbering)
            publisher.send(Note(**numbering.next(), text="last"), [image])
            for subscriber in (early, late):

                def last(subscriber=subscriber):
                    return (it := subscriber.latest(0.1)) and it.header.text == "last" and it

                message = wait_for(last)
                assert np.array_equal(message.arrays[0], image)
                assert subscriber.age_s < 30 and subscriber.refused == 0


def test_losses_are_counted_and_a_new_session_counts_anew(tmp_path):
    network, numbering = ipc(tmp_path), Numbering()
    with Subscriber(CAPTURE_PREVIEW, network, Note) as subscriber:
        with Publisher(CAPTURE_PREVIEW, network) as publisher:
            heard(publisher, subscriber, numbering)
            wait_for(lambda: subscriber.latest(0.1) is None)
            before = subscriber.lost
            numbering.sequence += 5
            heard(publisher, subscriber, numbering)
            assert subscriber.lost == before + 5
        with Publisher(CAPTURE_PREVIEW, network) as publisher:
            restarted = Numbering()
            heard(publisher, subscriber, restarted)
            wait_for(lambda: subscriber.latest(0.1) is None)
            assert subscriber.lost == before + 5


def test_the_newest_wins_when_the_reader_is_slow(tmp_path):
    network, numbering = ipc(tmp_path), Numbering()
    with Publisher(CAPTURE_PREVIEW, network) as publisher, Subscriber(CAPTURE_PREVIEW, network, Note) as subscriber:
        heard(publisher, subscriber, numbering)

        def read_after_twenty():
            """Whether the first that is read is the last: where all of them have come by then."""
            for _ in range(20):
                publisher.send(Note(**numbering.next()))
                time.sleep(0.005)
            return (it := subscriber.latest(0.1)) and it.header.sequence == numbering.sequence - 1

        wait_for(read_after_twenty)
        assert subscriber.latest(0) is None


def test_a_sender_never_waits(tmp_path):
    network, numbering = ipc(tmp_path), Numbering()
    image = np.zeros(1_000_000, np.uint8)
    with Publisher(CAPTURE_PREVIEW, network) as publisher, Subscriber(CAPTURE_PREVIEW, network, Note) as subscriber:
        heard(publisher, subscriber, numbering)
        start = time.monotonic()
        for _ in range(300):
            publisher.send(Note(**numbering.next()), [image])
        assert time.monotonic() - start < 20  # the subscriber sleeps


@pytest.mark.parametrize("count", [2, 3])
def test_one_process_offers_a_service(network, count):
    with Publisher(CAPTURE_PREVIEW, network):
        for _ in range(count):
            with pytest.raises(AlreadyRunning, match=f"offered by process {os.getpid()}") as caught:
                Publisher(CAPTURE_PREVIEW, network)
            assert caught.value.pid == os.getpid() and caught.value.exit_code == 75
    Publisher(CAPTURE_PREVIEW, network).close()


DIES = """
import os, sys, pathlib
from splatnode.capture.messaging.pubsub import Publisher
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.network import CAPTURE_PREVIEW
publisher = Publisher(CAPTURE_PREVIEW, Network(directory=pathlib.Path(sys.argv[1])))
os.kill(os.getpid(), 9)
"""


def test_a_killed_process_leaves_nothing_in_the_way(tmp_path):
    network = ipc(tmp_path)
    directory = runtime_directory(network)
    assert subprocess.run([sys.executable, "-c", DIES, directory], cwd=ROOT).returncode == -9
    assert (directory / CAPTURE_PREVIEW.name).exists()  # the socket of a dead process
    with Publisher(CAPTURE_PREVIEW, network) as publisher, Subscriber(CAPTURE_PREVIEW, network, Note) as subscriber:
        heard(publisher, subscriber, Numbering())


def test_late_comers_get_the_state(network):
    numbering = Numbering()
    means = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    with StateServer(RECON_SCENE, network) as server:
        server.publish(Note(**numbering.next(), text="before"), [means])

        def served(client):
            server.serve(0.02)
            return client.poll(0.02)

        with StateClient(RECON_SCENE, network, Note) as client:
            message = wait_for(lambda: served(client))
            assert message.header.text == "before" and np.array_equal(message.arrays[0], means)
            assert served(client) is None and client.age_s < 30
            server.publish(Note(**numbering.next(), text="after"))
            assert wait_for(lambda: served(client)).header.text == "after"
            for _ in range(30):  # asks again, and is told nothing that it has
                assert served(client) is None


def test_a_state_is_sent_once_to_a_client_that_asks_again_while_it_is_arriving(tmp_path):
    numbering = Numbering()
    with StateServer(RECON_SCENE, ipc(tmp_path)) as server:
        server.publish(Note(**numbering.next()))

        def answers(client, since_s=0.2):
            """How many replies come to one that asks five times."""
            for _ in range(5):
                client._asked = -math.inf
                wait_for(lambda: client._ask() or client._asked > 0)
                server.serve(since_s)
            count = 0
            while client._dealer.poll(200):
                count += bool(client._dealer.recv_multipart())
            return count

        for _ in range(2):  # another connection has a copy of its own
            with StateClient(RECON_SCENE, ipc(tmp_path), Note) as client:
                assert answers(client) == 1
                server.publish(Note(**numbering.next()))
                assert answers(client) == 1
        assert len(server._sent) == 2


def test_a_restarted_sender_is_followed_and_its_predecessor_is_not(tmp_path):
    network = ipc(tmp_path)
    with StateClient(RECON_SCENE, network, Note) as client:
        sessions = []
        for _ in range(2):
            numbering = Numbering()
            with StateServer(RECON_SCENE, network) as server:
                for _ in range(3):
                    server.publish(Note(**numbering.next()))
                server.publish(Note(**numbering.next(), text="newest"))

                def served(server=server):
                    server.serve(0.02)
                    return client.poll(0.02)

                message = wait_for(served)
                assert message.header.text == "newest"
                sessions.append(message.header.session)
        assert sessions[0] != sessions[1]
        assert not client._is_newer(Note(session=sessions[0], sequence=99, mono_ns=0))


def test_of_one_session_each_state_is_newer_than_those_before_it(tmp_path):
    with StateClient(RECON_SCENE, ipc(tmp_path), Note) as client:
        one, other = "1" * 32, "2" * 32
        told = [(one, 3), (one, 3), (one, 2), (one, 0), (one, 4), (other, 0), (other, 1), (one, 9), (other, 1)]
        newer = [client._is_newer(Note(session=session, sequence=number, mono_ns=0)) for session, number in told]
        assert newer == [True, False, False, False, True, True, True, False, False]


class Question(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="question"):
    number: int


def test_commands_are_answered(network):
    with CommandServer(RECON_CONTROL, network, Question) as server, ThreadPoolExecutor() as client:
        asked = client.submit(ask, RECON_CONTROL, network, Question(20), Question, timeout_s=30.0)
        while not asked.done():
            server.serve(0.05, lambda question: Question(question.number + 1))
        assert asked.result() == Question(21)


def test_a_command_to_nobody_says_so(tmp_path):
    with pytest.raises(NoAnswer, match="recon.control did not answer"):
        ask(RECON_CONTROL, ipc(tmp_path), Question(1), Question, timeout_s=0.1)


def test_rubbish_on_a_socket_is_counted(tmp_path):
    network = ipc(tmp_path)
    with StateServer(RECON_SCENE, network) as server, zmq.Context() as context:
        with context.socket(zmq.DEALER) as dealer:
            dealer.linger = 0
            dealer.connect(f"ipc://{runtime_directory(network) / RECON_SCENE.requests.name}")
            for parts in ([b""], [b"hello"], [b"SPLAT\x01", b"\x90"], [b"x"] * 50):
                dealer.send_multipart(parts)

            def served():
                server.serve(0.05)
                return server.refused == 4

            wait_for(served)
        with context.socket(zmq.PUB) as impostor, Subscriber(CAPTURE_PREVIEW, network, Note) as subscriber:
            impostor.linger = 0
            impostor.bind(f"ipc://{runtime_directory(network) / CAPTURE_PREVIEW.name}")

            def refused():
                impostor.send_multipart([b"SPLAT\x01", b"no"])
                assert subscriber.latest(0.02) is None
                return subscriber.refused

            wait_for(refused)
