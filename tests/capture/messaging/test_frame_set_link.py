"""Captures tell each other when they took keyframes; one that is gone, or a stranger's datagram, disturbs nothing."""

from __future__ import annotations

import socket
import struct

import pytest

from splatnode.capture.frame import LARGEST_NS, Clock, Stamp
from splatnode.capture.messaging import pubsub
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.pubsub import FULL_S, FrameSetLink

AT = Stamp(1_700_000_000_123_456_789, Clock.UTC)


@pytest.fixture
def network(tmp_path) -> Network:
    return Network(directory=tmp_path / "run")


def test_each_of_three_hears_what_the_others_took_and_not_itself(network):
    with FrameSetLink(network, "left") as left, FrameSetLink(network, "right") as right:
        with FrameSetLink(network, "rear") as rear:
            left.announce(AT)
            right.announce(Stamp(5, Clock.RECORDING))
            assert left.receive() == [Stamp(5, Clock.RECORDING)] and right.receive() == [AT]
            assert rear.receive() == [AT, Stamp(5, Clock.RECORDING)] and rear.receive() == []
        left.announce(AT)
        assert right.receive() == [AT]


def test_one_that_was_killed_is_left_out_until_it_is_started_again(network):
    with FrameSetLink(network, "left") as left:
        killed = FrameSetLink(network, "right")
        killed._socket.close()  # its file stays
        left.announce(AT)
        with FrameSetLink(network, "right") as right:
            left.announce(AT)
            assert right.receive() == [AT]


def test_one_that_does_not_listen_keeps_nobody_waiting(network):
    with FrameSetLink(network, "left") as left, FrameSetLink(network, "right") as right:
        for _ in range(2000):
            left.announce(AT)
        assert 0 < len(right.receive()) <= 100


def test_what_no_capture_sends_is_no_time(network):
    with FrameSetLink(network, "left") as left, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        for data in (
            b"",
            b"x" * 5000,
            struct.pack("<4sBq", b"SET9", 0, 1),
            struct.pack("<4sBq", b"SET1", 200, 1),
            struct.pack("<4sBq", b"SET1", 0, -1),
            struct.pack("<4sBq", b"SET1", 0, LARGEST_NS + 1),
        ):
            stranger.sendto(data, str(left._path))
        assert left.receive() == []


def test_one_that_has_no_room_says_so_for_a_while(network, monkeypatch):
    with FrameSetLink(network, "left") as left, FrameSetLink(network, "right") as right:
        assert not right.is_another_full
        left.announce_full()
        assert right.receive() == [] and right.is_another_full and not left.is_another_full
        now_s = pubsub.time.monotonic()
        monkeypatch.setattr(pubsub.time, "monotonic", lambda: now_s + FULL_S + 0.1)
        assert not right.is_another_full
