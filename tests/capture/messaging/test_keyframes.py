"""No keyframe that was offered is lost, and none is delivered twice, whoever dies in between."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from splatnode.capture.frame import Clock, DroppedFrame, Frame, Intrinsics, Stamp, make_given_pose
from splatnode.capture.messaging import keyframe_queue
from splatnode.capture.messaging.keyframe_queue import (
    KeyframeClient,
    KeyframeServer,
    Spool,
    SpoolConfig,
    SpoolFull,
    spool_directory,
)
from splatnode.capture.messaging.messages import (
    MAGIC,
    Delivery,
    FrameHeader,
    Key,
    Refuse,
    Request,
    WireError,
    add_delivery,
    decode,
    encode,
)
from splatnode.capture.messaging.network import CAPTURE_KEYFRAMES, AlreadyRunning, Network, runtime_directory
from splatnode.capture.process.files import LockHeld
from tests.capture.messaging.test_sockets import ipc, tcp, wait_for
from tests.conftest import ROOT
from tests.support.schemas import without
from tests.support.strays import STRAYS

INTRINSICS = Intrinsics(8, 6, 10.0, 10.0, 4.0, 3.0, "calibration", (0.1, -0.2))
KEY = Key("0" * 32, 0)
MOVED = np.array([[0.0, -1.0, 0.0, 1.5], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


def frame(index, size=(6, 8)):
    image = np.random.default_rng(index).integers(0, 256, (*size, 3)).astype(np.uint8)
    lens, captured_at = (INTRINSICS, Stamp(index + 10**18, Clock.UTC)) if index % 2 else (None, None)
    pose = make_given_pose(MOVED, 0.02, 1.5) if index % 2 else None
    return Frame(index, f"{index}.png", index * 1000, image, lens, captured_at=captured_at, given_pose=pose)


def open_spool(folder, **limits):
    return Spool(SpoolConfig(folder / "state", **limits))


def receive(server, client, count, seconds=30.0):
    received = []
    deadline = time.monotonic() + seconds
    while len(received) < count and time.monotonic() < deadline:
        server.serve(0.005)
        if (one := client.receive(0.005)) is not None:
            received.append(one)
    return received


def settle(server, client, until=lambda: True):
    """What was said is heard: until this is so, and for a while, in which what must not come could."""

    def serve():
        server.serve(0.01)
        assert client.receive(0.005) is None
        return until()

    wait_for(serve)
    for _ in range(10):
        serve()


def assert_same(received, sent):
    assert (received.frame_id, received.name, received.stamp_ns) == (sent.frame_id, sent.name, sent.stamp_ns)
    assert received.captured_at == sent.captured_at
    assert (
        received.intrinsics == sent.intrinsics
        and received.given_pose == sent.given_pose
        and np.array_equal(received.image, sent.image)
    )


@pytest.mark.parametrize("make", [ipc, tcp], ids=["ipc", "tcp+curve"])
def test_frames_arrive_in_order_and_leave_the_spool_when_acknowledged(tmp_path, make):
    network, spool = make(tmp_path), open_spool(tmp_path)
    with KeyframeClient(network, capacity=3) as client, KeyframeServer(network, spool) as server:
        for index in range(6):
            server.offer(frame(index))
        server.offer(DroppedFrame("blurred.png", "blurred: its edges are 9 px wide"))
        received = receive(server, client, 3)
        assert [one.sequence for one in received] == [0, 1, 2]
        settle(server, client)
        assert server.num_queued == 7 and client.receive(0) is None  # its capacity is used up
        for one in received:
            assert_same(one.frame, frame(one.sequence))
            client.acknowledge(one)
        received = receive(server, client, 3)
        assert server.num_queued == 4 and server.acknowledged == 3
        for one in received:
            client.acknowledge(one)
        (dropped,) = receive(server, client, 1)
        assert dropped.frame == DroppedFrame("blurred.png", "blurred: its edges are 9 px wide")
        client.acknowledge(dropped)
        settle(server, client, lambda: server.num_queued == 0)
        assert server.num_queued == 0 and client.duplicates == client.refused == server.refused == 0


def test_a_new_recon_gets_what_the_old_one_had_not_acknowledged(tmp_path, monkeypatch):
    monkeypatch.setattr(keyframe_queue, "SILENT_S", 1.5)
    network, spool = ipc(tmp_path), open_spool(tmp_path)
    with KeyframeServer(network, spool) as server:
        for index in range(3):
            server.offer(frame(index))
        with KeyframeClient(network) as killed:
            first, second, _third = receive(server, killed, 3)
            killed.acknowledge(first)
            settle(server, killed, lambda: server.num_queued == 2)
        with KeyframeClient(network, seen=[first.key, second.key]) as client:  # the checkpoint also holds the second
            assert [one.sequence for one in receive(server, client, 1)] == [2]
            settle(server, client, lambda: client.duplicates and server.num_queued == 1)
            assert client.duplicates == 1 and server.num_queued == 1


def test_a_restarted_capture_does_not_send_again_what_recon_holds(tmp_path):
    network = ipc(tmp_path)
    with KeyframeClient(network) as client:
        with KeyframeServer(network, open_spool(tmp_path)) as server:
            server.offer(frame(0))
            server.offer(frame(1))
            held = receive(server, client, 2)
        with KeyframeServer(network, open_spool(tmp_path)) as server:
            server.offer(frame(2))
            (new,) = receive(server, client, 1)
            assert new.session != held[0].session and new.sequence == 0
            settle(server, client)
            assert client.duplicates == 0
            for one in (*held, new):
                client.acknowledge(one)
            settle(server, client, lambda: server.num_queued == 0)


KILLED = """
import os, pathlib, sys, numpy
from splatnode.capture.process.files import LockHeld
from splatnode.capture.frame import Frame
from splatnode.capture.messaging.keyframe_queue import KeyframeServer
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.keyframe_queue import SpoolConfig, Spool
folder = pathlib.Path(sys.argv[1])
server = KeyframeServer(Network(directory=folder / "run"), Spool(SpoolConfig(folder / "state")))
for index in range(3):
    server.offer(Frame(index, f"{index}.png", index, numpy.full((6, 8, 3), index, numpy.uint8), None))
os.kill(os.getpid(), 9)
"""


def test_what_was_offered_survives_a_kill(tmp_path):
    assert subprocess.run([sys.executable, "-c", KILLED, tmp_path], cwd=ROOT).returncode == -9
    network = ipc(tmp_path)
    with KeyframeServer(network, open_spool(tmp_path)) as server, KeyframeClient(network) as client:
        server.offer(frame(3))
        received = receive(server, client, 4)
        assert len({one.session for one in received}) == 2
        assert [one.frame.name for one in received] == ["0.png", "1.png", "2.png", "3.png"]
        assert [one.frame.image.max() for one in received[:3]] == [0, 1, 2]


def test_one_process_offers_keyframes(tmp_path):
    with KeyframeServer(ipc(tmp_path), open_spool(tmp_path)):
        with pytest.raises(AlreadyRunning):
            KeyframeServer(ipc(tmp_path), open_spool(tmp_path / "other"))
        with pytest.raises(LockHeld):
            open_spool(tmp_path)
    open_spool(tmp_path / "other").close()  # the one that came too late has let go of its spool


HEADER = FrameHeader(
    session="0" * 32, sequence=0, mono_ns=0, frame_id=0, name="a.png", stamp_ns=0, intrinsics=INTRINSICS
)
IMAGE = np.zeros((6, 8, 3), np.uint8)
changed = msgspec.structs.replace


def unusual(**numbers):
    """Intrinsics that no process of ours makes."""
    made = replace(INTRINSICS)
    for name, number in numbers.items():
        object.__setattr__(made, name, number)
    return made


def unusual_stamp(**parts):
    """A time that no process of ours tells."""
    made = Stamp(1, Clock.UTC)
    for name, part in parts.items():
        object.__setattr__(made, name, part)
    return made


def unusual_pose(**parts):
    """A pose that no process of ours gives."""
    made = make_given_pose(MOVED)
    for name, part in parts.items():
        object.__setattr__(made, name, part)
    return made


NO_KEYFRAMES = {
    "no image": encode(HEADER),
    "two images": encode(HEADER, [IMAGE, IMAGE]),
    "grey": encode(HEADER, [IMAGE[..., 0]]),
    "floats": encode(HEADER, [IMAGE.astype(np.float32)]),
    "empty": encode(HEADER, [IMAGE[:0]]),
    "empty and endless": [*encode(HEADER)[:1], msgspec.msgpack.encode([HEADER, [["u1", [0, 2**62, 4]]]]), b""],
    "side": encode(HEADER, [np.zeros((1, 70_000, 3), np.uint8)]),
    "another number": encode(changed(HEADER, sequence=7), [IMAGE]),
    "stamp": encode(changed(HEADER, stamp_ns=5 * 10**18), [IMAGE]),
    "negative stamp": encode(changed(HEADER, stamp_ns=-1), [IMAGE]),
    "capture": encode(changed(HEADER, captured_at=unusual_stamp(ns=5 * 10**18)), [IMAGE]),
    "clock": encode(changed(HEADER, captured_at=unusual_stamp(clock="sundial")), [IMAGE]),
    "pose that is none": encode(changed(HEADER, given_pose=None), [IMAGE]),
    "mirrored pose": encode(
        changed(HEADER, given_pose=unusual_pose(T_world_camera=tuple(np.diag([1.0, 1, -1, 1]).ravel().tolist()))),
        [IMAGE],
    ),
    "short pose": encode(changed(HEADER, given_pose=unusual_pose(T_world_camera=(1.0,) * 15)), [IMAGE]),
    "far pose": encode(
        changed(HEADER, given_pose=unusual_pose(T_world_camera=tuple((MOVED * [1, 1, 1, 1e7]).ravel().tolist()))),
        [IMAGE],
    ),
    "pose without sigma": encode(changed(HEADER, given_pose=unusual_pose(sigma_m=0.0)), [IMAGE]),
    "pose without end": encode(changed(HEADER, given_pose=unusual_pose(sigma_deg=float("inf"))), [IMAGE]),
    "id": encode(changed(HEADER, frame_id=2**63), [IMAGE]),
    "no name": encode(changed(HEADER, name=""), [IMAGE]),
    "terminal": encode(changed(HEADER, name="\x1b[2J"), [IMAGE]),
    "long name": encode(changed(HEADER, name="a" * 256), [IMAGE]),
    "nan": encode(changed(HEADER, intrinsics=unusual(fx=float("nan"))), [IMAGE]),
    "focal": encode(changed(HEADER, intrinsics=unusual(fy=1e300)), [IMAGE]),
    "lens": encode(changed(HEADER, intrinsics=unusual(distortion=(0.0,) * 15)), [IMAGE]),
    "lens's size": encode(changed(HEADER, intrinsics=unusual(width=2**40)), [IMAGE]),
    "source": encode(changed(HEADER, intrinsics=unusual(source="\x1b")), [IMAGE]),
    "rubbish": [MAGIC, b"junk"],
    "version 1": [b"SPLAT\x01", *encode(HEADER, [IMAGE])[1:]],
    "nothing": [],
}


@contextmanager
def impostor_of_capture(network, client):
    """Sends what it likes to the client."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as impostor:
        impostor.linger = 0
        impostor.bind(f"ipc://{runtime_directory(network) / CAPTURE_KEYFRAMES.name}")
        wait_for(lambda: client.receive(0.01) or impostor.poll(10))
        identity, *_ = impostor.recv_multipart()

        def send(parts):
            impostor.send_multipart([identity, *parts])

        def answers():
            while impostor.poll(0):
                yield decode(impostor.recv_multipart()[1:], Request).header

        send.answers = answers
        yield send


@pytest.mark.parametrize("parts", NO_KEYFRAMES.values(), ids=NO_KEYFRAMES)
def test_what_is_no_keyframe_is_refused_by_its_number_and_the_next_is_taken(tmp_path, parts):
    network = ipc(tmp_path)
    with KeyframeClient(network) as client, impostor_of_capture(network, client) as send:
        for _ in range(2):  # a refused one that comes again is known
            send(add_delivery(KEY, parts))
        send(add_delivery(Key("0" * 32, 1), encode(changed(HEADER, sequence=1), [IMAGE])))
        received = client.receive(30)
        assert received.key.sequence == 1 and client.refused == 1
        client.receive(0.1)
        refusals = [answer for answer in send.answers() if isinstance(answer, Refuse)]
        assert [(each.session, each.sequence) for each in refusals] == [KEY, KEY] and refusals[0].reason


def test_what_does_not_say_which_frame_it_is_is_counted_and_the_journal_is_not_filled(tmp_path, caplog):
    network = ipc(tmp_path)
    with KeyframeClient(network) as client, impostor_of_capture(network, client) as send:
        rubbish = [
            [b""],
            [b"hello"],
            [MAGIC, b"\x90"],
            encode(HEADER, [IMAGE]),
            encode(Delivery("x", 0)),
            [b"x"] * 50,
        ]
        for parts in rubbish:
            send(parts)
        send(add_delivery(KEY, encode(HEADER, [IMAGE])))
        assert client.receive(30).frame.name == "a.png"
        assert client.refused == len(rubbish)
    told = [record for record in caplog.records if "refused a keyframe" in record.message]
    assert len(told) == len(rubbish).bit_length()  # the 1st, 2nd, 4th, ...


def test_a_recon_of_before_poses_refuses_a_keyframe_with_one_by_a_sentence_and_takes_the_next(tmp_path, monkeypatch):
    network, spool = ipc(tmp_path), open_spool(tmp_path)
    with KeyframeServer(network, spool) as server, KeyframeClient(network) as client:
        server.offer(frame(1))  # with a pose
        server.offer(frame(2))
        earlier = without(FrameHeader, "given_pose")
        monkeypatch.setattr("splatnode.capture.messaging.messages.FrameHeader", earlier)
        (one,) = receive(server, client, 1)
        assert one.frame.name == "2.png"
        settle(server, client, lambda: server.set_aside)
        (aside,) = spool.quarantine.newest(2)
        assert aside.name == "1.png" and "header refused: Object contains unknown field `given_pose`" in aside.reason


def test_refused_keyframes_make_way_and_are_named(tmp_path):
    network, spool = ipc(tmp_path), open_spool(tmp_path)
    with KeyframeServer(network, spool) as server:
        for index in range(30):
            server.offer(frame(index))
        with KeyframeClient(network) as client:
            taken = []

            def done():
                server.serve(0.005)
                one = client.receive(0.005)
                if one is not None and one.sequence % 3 == 0:
                    client.refuse(one.key, f"no room for {one.frame.name}")
                elif one is not None:
                    client.acknowledge(one)
                    taken.append(one.sequence)
                return server.num_queued == 0

            wait_for(done)
            assert taken == [index for index in range(30) if index % 3]
            named = spool.quarantine.newest(30)
            assert [each.name for each in named] == [f"{index}.png" for index in range(27, -1, -3)]
            assert named[0].reason == "refused by recon: no room for 27.png"
            assert server.set_aside == 10 and server.acknowledged == 20 and client.refused == 10


def test_eight_frames_that_recon_refuses_block_no_queue(tmp_path):
    """What an earlier splatnode accepted and recon does not: more of them than recon holds at a time."""
    network, spool = ipc(tmp_path), open_spool(tmp_path)
    for index in range(8):
        header = changed(HEADER, sequence=index, stamp_ns=5 * 10**18, name=f"{index}.png")
        spool.store(Key(header.session, index), encode(header, [IMAGE]))
    with KeyframeServer(network, spool) as server, KeyframeClient(network) as client:
        server.offer(frame(0))
        (received,) = receive(server, client, 1)
        assert received.frame.name == "0.png" and server.num_queued == 1
        assert {each.name for each in spool.quarantine.newest(9)} == {f"{index}.png" for index in range(8)}
        assert "stamp_ns" in spool.quarantine.newest(1)[0].reason


def test_what_is_larger_than_recon_allows_is_set_aside_without_being_sent(tmp_path):
    network, spool = ipc(tmp_path), open_spool(tmp_path)
    with KeyframeServer(network, spool) as server:
        server.offer(frame(0, size=(700, 700)))
        server.offer(frame(1))
        with KeyframeClient(msgspec.structs.replace(network, max_message_mb=1)) as client:
            (received,) = receive(server, client, 1)
            assert received.frame.name == "1.png" and client.refused == 0
        (record,) = spool.quarantine.newest(2)
        assert record.name == "0.png" and "raise network.max_message_mb there" in record.reason


def test_what_version_1_spooled_is_delivered(tmp_path):
    network, spool = ipc(tmp_path), open_spool(tmp_path)
    spool.store(KEY, [b"SPLAT\x01", *encode(HEADER, [IMAGE])[1:]])
    with KeyframeServer(network, spool) as server, KeyframeClient(network) as client:
        assert receive(server, client, 1)[0].frame.name == "a.png"


@pytest.mark.parametrize("request_of_another", [[b"SPLAT\x01", b"\x92"], [b"SPLAT\x09", b"\x92"]])
def test_another_version_is_told_which_is_older(tmp_path, request_of_another):
    network = ipc(tmp_path)
    with KeyframeServer(network, open_spool(tmp_path)) as server, zmq.Context() as context:
        with context.socket(zmq.DEALER) as other:
            other.linger = 0
            other.connect(f"ipc://{runtime_directory(network) / CAPTURE_KEYFRAMES.name}")
            other.send_multipart(request_of_another)
            wait_for(lambda: server.serve(0.01) or server.refused)
        assert "update the older one" in server.why_refused


def test_too_large_is_said_before_it_is_spooled(tmp_path):
    network = Network(directory=tmp_path / "run", max_message_mb=1)
    with KeyframeServer(network, open_spool(tmp_path)) as server:
        with pytest.raises(WireError, match="max_message_mb"):
            server.offer(frame(0, size=(700, 700)))
        assert server.num_queued == 0


def test_the_spool_is_bounded(tmp_path):
    spool = open_spool(tmp_path, max_frames=2)
    spool.store(KEY, [b"a"])
    spool.store(KEY._replace(sequence=1), [b"b"])
    with pytest.raises(SpoolFull, match="is splatnode recon running"):
        spool.store(KEY._replace(sequence=2), [b"c"])
    spool.remove(KEY)
    spool.store(KEY._replace(sequence=2), [b"c"])
    assert [key.sequence for key in spool] == [1, 2]
    small = Spool(SpoolConfig(tmp_path / "other", max_mb=1))
    with pytest.raises(SpoolFull):
        small.store(KEY, [bytes(1 << 20)])


def test_what_a_killed_process_left_is_delivered_before_what_its_successor_adds(tmp_path):
    left, added = KEY._replace(session="f" * 32), KEY
    for key, sequences in ((left, (0, 1)), (added, (0, 1, 2))):
        spool = open_spool(tmp_path)
        for sequence in sequences:
            spool.store(key._replace(sequence=sequence), [b"a"])
        spool.close()
    assert list(open_spool(tmp_path)) == [left._replace(sequence=i) for i in (0, 1)] + [
        added._replace(sequence=i) for i in (0, 1, 2)
    ]


def test_a_full_disk_is_a_full_spool_and_leaves_nothing(tmp_path, monkeypatch):
    spool = open_spool(tmp_path)

    def no_space(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("splatnode.capture.process.files.os.fsync", no_space)
    with pytest.raises(SpoolFull, match="No space left"):
        spool.store(KEY, [b"a"])
    assert len(spool) == 0 and [path.name for path in spool.directory.iterdir()] == ["lock"]


def test_damaged_files_are_put_aside(tmp_path):
    spool = open_spool(tmp_path)
    for sequence in range(4):
        spool.store(KEY._replace(sequence=sequence), [b"content", b"of the message"])
    paths = sorted(spool.directory.glob("*.frame"))
    paths[0].write_bytes(paths[0].read_bytes()[:-1])
    flipped = bytearray(paths[2].read_bytes())
    flipped[-1] ^= 1
    paths[2].write_bytes(bytes(flipped))
    paths[3].write_bytes(b"")
    (spool.directory / ".half.tmp").write_bytes(b"half")
    (spool.directory / "stranger.frame").write_bytes(b"?")
    spool.close()
    again = open_spool(tmp_path)
    assert [key.sequence for key in again] == [1]
    assert [bytes(part) for part in again.get(KEY._replace(sequence=1))] == [b"content", b"of the message"]
    assert len(again.quarantine) == 3 and "damaged on the disk" in again.quarantine.newest(1)[0].reason
    assert (spool.directory / "stranger.frame").read_bytes() == b"?"  # it is not ours
    assert not list(spool.directory.glob(".*"))


def test_a_frame_that_the_disk_loses_does_not_block_the_others(tmp_path):
    network, spool = ipc(tmp_path), open_spool(tmp_path)
    with KeyframeServer(network, spool) as server, KeyframeClient(network) as client:
        server.offer(frame(0))
        server.offer(frame(1))
        next(iter(spool.directory.glob("000000000000-*"))).write_bytes(b"rot")
        assert [one.sequence for one in receive(server, client, 1)] == [1]
        assert server.num_queued == 1


def test_where_the_spool_is(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert spool_directory(SpoolConfig()) == tmp_path / "home" / "splatnode" / "spool"
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "service"))
    assert spool_directory(SpoolConfig()) == Path(tmp_path, "service", "spool")
    holder = Spool(SpoolConfig())
    with pytest.raises(LockHeld, match=f"held by process {os.getpid()}"):
        Spool(SpoolConfig())
    holder.close()


@pytest.mark.parametrize("make", STRAYS.values(), ids=STRAYS)
@pytest.mark.parametrize(
    "name",
    [
        "copy of 000000000000-{session}-5.frame",
        "000000000003-{session}-3.frame",
        "000000000003-{session}-x.frame",
        "{many}-{session}-3.frame",
        "x-y.frame",
        ".x.tmp",
        ".frame",
        "\udcff\n.frame",
    ],
)
def test_what_is_no_file_of_the_spool_is_left_alone(tmp_path, make, name):
    spool = open_spool(tmp_path)
    spool.store(KEY, [b"content"])
    spool.close()
    stray = spool.directory / name.format(session=KEY.session, many="9" * 60)
    make(stray)
    again = open_spool(tmp_path)
    assert list(again) == [KEY] and os.path.lexists(stray)
    again.store(KEY._replace(sequence=9), [b"more"])
    assert [key.sequence for key in again] == [KEY.sequence, 9]
    again.close()


def test_a_copy_and_a_file_larger_than_the_bound_are_left_alone(tmp_path, caplog):
    spool = open_spool(tmp_path)
    spool.store(KEY, [b"content"])
    (path,) = spool.directory.glob("*.frame")
    spool.close()
    path.with_name(f"000000000004{path.name[12:]}").write_bytes(path.read_bytes())
    with path.with_name(f"000000000007-{KEY.session}-7.frame").open("wb") as file:
        file.truncate(10 << 30)
    again = open_spool(tmp_path)
    assert list(again) == [KEY] and len(list(spool.directory.glob("*.frame"))) == 3
    assert "a copy of a keyframe" in caplog.text and "spool.max_mb" in caplog.text
