"""Each keyframe is given away once: one recon is served, and the others are told so."""

from __future__ import annotations

import time

import pytest

from splatnode.capture.messaging import keyframe_queue
from splatnode.capture.messaging.keyframe_queue import (
    MOST_CONNECTIONS,
    SILENT_S,
    ConsumerArbiter,
    KeyframeClient,
    KeyframeServer,
)
from splatnode.capture.messaging.messages import Acknowledge, Key, Ready, Refuse
from tests.capture.messaging.test_keyframes import frame, open_spool, receive, settle
from tests.capture.messaging.test_sockets import ipc, tcp, wait_for

A, B = "a" * 32, "b" * 32
KEY = Key("0" * 32, 0)


def ready(recon=A, process=A, holding=()):
    return Ready(recon, process, 4, [*holding], 10**6)


def test_the_one_that_is_served_stays_until_it_is_silent():
    asked = ConsumerArbiter()
    assert asked.handle_ready(b"1", ready(A, A), (), 0.0)
    assert not asked.handle_ready(b"2", ready(B, B), (), 1.0) and asked.num_rejected == 1
    assert asked.is_active(b"1") and not asked.is_active(b"2")
    asked.record_keep_alive(b"1", 4.0)
    assert not asked.handle_ready(b"2", ready(B, B), (), 4.0 + SILENT_S)
    assert asked.handle_ready(b"2", ready(B, B), (), 4.1 + SILENT_S) and asked.is_active(b"2")
    assert not asked.handle_ready(b"1", ready(A, A), (), 4.2 + SILENT_S)


def test_a_restarted_one_takes_over_at_once_and_its_predecessor_does_not_come_back():
    asked = ConsumerArbiter()
    assert asked.handle_ready(b"1", ready(A, "1" * 32), (), 0.0)
    assert asked.handle_ready(b"2", ready(A, "2" * 32), (), 0.1)
    assert not asked.handle_ready(b"1", ready(A, "1" * 32), (), 0.2)  # a copy of the checkpoint: the later one stays
    assert asked.handle_ready(b"3", ready(A, "2" * 32), (), 0.3)  # the same process by a new connection


def test_a_predecessor_is_not_counted_among_those_that_wait_and_a_copy_that_lives_is():
    asked = ConsumerArbiter()
    assert asked.handle_ready(b"1", ready(A, "1" * 32), (), 0.0)
    assert asked.handle_ready(b"1 again", ready(A, "1" * 32), (), 0.5)  # a second connection of the same process
    assert asked.handle_ready(b"2", ready(A, "2" * 32), (), 1.0) and asked.num_rejected == 0
    assert (
        asked.handle_ready(b"3", ready(A, "3" * 32), (), 2.0 + SILENT_S) and asked.num_rejected == 0
    )  # it took long to start
    assert not asked.handle_ready(b"2", ready(A, "2" * 32), (), 2.1 + SILENT_S) and asked.num_rejected == 1
    assert asked.is_active(b"3")


def test_a_crowd_keeps_neither_the_one_that_is_served_out_nor_its_next_process():
    asked = ConsumerArbiter()
    assert asked.handle_ready(b"1", ready(A, "1" * 32), (), 0.0)
    for index in range(3 * MOST_CONNECTIONS):
        assert not asked.handle_ready(b"crowd %d" % index, ready(B, f"{index:032x}"), (), 1.0 + index / 1000)
    assert asked.num_rejected == MOST_CONNECTIONS - 1
    assert asked.handle_ready(b"1", ready(A, "1" * 32), (), 2.0)
    assert asked.handle_ready(b"2", ready(A, "2" * 32), (), 2.1)  # a restart in the crowd


def test_who_is_gone_makes_room():
    asked = ConsumerArbiter()
    asked.handle_ready(b"1", ready(A, A), (), 0.0)
    asked.forget_silent(100.0)
    assert asked.active is None and asked.handle_ready(b"2", ready(B, B), (), 100.0)
    asked.remove_connection(b"2")
    assert asked.active is None


def test_what_is_held_is_outstanding_if_it_is_still_there():
    asked = ConsumerArbiter()
    asked.handle_ready(b"1", ready(holding=[KEY, ("0" * 32, 1)]), [KEY], 0.0)
    assert asked.active.outstanding == {KEY}
    asked.mark_answered(KEY)
    assert asked.active.outstanding == set()


@pytest.mark.parametrize("make", [ipc, tcp], ids=["ipc", "tcp+curve"])
def test_two_recons_on_one_capture(tmp_path, make, monkeypatch):
    """The second takes nothing and is told so; when the first falls silent, it gets what is left."""
    monkeypatch.setattr(keyframe_queue, "SILENT_S", 1.5)
    network, spool = make(tmp_path), open_spool(tmp_path)
    with KeyframeServer(network, spool) as server, KeyframeClient(network) as second:
        with KeyframeClient(network) as first:
            for index in range(3):
                server.offer(frame(index))
            held = receive(server, first, 3)
            deadline = time.monotonic() + 3.0
            while time.monotonic() < deadline:  # longer than one may be silent
                server.serve(0.01)
                assert second.receive(0.01) is None
                assert first.receive(0.01) is None
            assert first.served and second.served is False and server.num_rejected_consumers == 1
            for request in (Acknowledge(*held[0].key), Refuse(*held[1].key, "mine")):
                second._say(request)  # of one that is not served, neither counts
            wait_for(lambda: server.serve(0.01) or server.ignored == 2)
            assert server.num_queued == 3 and server.acknowledged == server.set_aside == 0
            first.acknowledge(held[0])
            settle(server, first, lambda: server.num_queued == 2)
        taken = receive(server, second, 2)
        assert [one.sequence for one in taken] == [1, 2] and second.served
        for one in taken:
            second.acknowledge(one)
        settle(server, second, lambda: server.num_queued == 0)
