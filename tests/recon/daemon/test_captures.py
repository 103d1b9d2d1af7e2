"""Several captures beside one recon: order of time, frame sets, an answer to each, and none is lost by a kill."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from splatnode.capture.frame import Clock, DroppedFrame, Frame, Stamp
from splatnode.capture.messaging.keyframe_queue import KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.messaging.network import AlreadyRunning, Network, find_captures
from splatnode.capture.process.terminal import Problems
from splatnode.capture.rig import form_frame_sets
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon import checkpoint as checkpoint_store
from splatnode.recon.daemon import ingest, ledger
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ingest import (
    ArrivedKeyframe,
    FrameSetConfig,
    FrameSetQueue,
    Inbox,
    RemovedFrame,
    WaitingFrame,
)
from splatnode.recon.daemon.ledger import read_frame
from splatnode.recon.daemon.node import Daemon, RemoveKeyframe
from splatnode.recon.daemon.submap_index import SubmapIndex, SubmapState, make_submap_record
from splatnode.recon.daemon.worker import InactiveSubmaps, Worker, number_frame_sets
from splatnode.recon.result.export import write_files
from splatnode.recon.result.export.stored import encode_cameras
from tests.capture.messaging.test_sockets import wait_for
from tests.conftest import ROOT
from tests.support.exported import make_camera, make_snapshot
from tests.support.three_captures import STEP_NS, install_camera

IMAGE = np.zeros((12, 16, 3), np.uint8)
IDS = ("left", "middle", "right")
CLIENT = SimpleNamespace(served=True)


def frame(camera_id: str, ms: int | None) -> Frame:
    at = None if ms is None else Stamp(ms * 1_000_000, Clock.UTC)
    return Frame(0, f"{camera_id}_{ms}", 0, IMAGE, None, captured_at=at, camera_id=camera_id)


def waiting(item, arrived_s=0.0, client=CLIENT) -> WaitingFrame:
    return WaitingFrame(client, ReceivedFrame("0" * 32, 0, item), arrived_s)


def take_all(queue: FrameSetQueue, now_s: float) -> list[list[str]]:
    found = []
    while together := queue.take(now_s):
        found.append([each.received.frame.name for each in together])
    return found


def test_frames_come_in_the_order_of_their_times_and_those_taken_together_as_one():
    queue = FrameSetQueue(FrameSetConfig(tolerance_s=0.02, wait_s=0.3))
    for camera_id, ms in (("right", 105), ("right", 305), ("left", 100), ("left", 200), ("left", 300)):
        queue.add(waiting(frame(camera_id, ms)))
    assert take_all(queue, 0.0) == [["left_100", "right_105"], ["left_200"], ["left_300", "right_305"]]


def test_a_frame_waits_for_the_other_cameras_and_no_longer_than_it_is_told():
    queue = FrameSetQueue(FrameSetConfig(wait_s=0.3))
    queue.add(waiting(frame("left", 100)))
    assert take_all(queue, 0.0) == [["left_100"]]  # no other camera is known: it does not wait
    queue.add(waiting(frame("right", 100), 0.1))
    queue.add(waiting(frame("right", 200), 0.2))
    assert take_all(queue, 0.2) == []  # left may still send one of that time
    assert take_all(queue, 0.45) == [["right_100"]]
    queue.add(waiting(frame("left", 210), 0.46))
    assert take_all(queue, 0.46) == [["right_200", "left_210"]]
    queue.add(waiting(frame("right", 9000), 9.0))
    assert take_all(queue, 9.0) == [["right_9000"]]  # left has been silent for long


def test_a_camera_that_is_waited_for_no_more_is_told_once_until_it_is_back(caplog):
    """It died while others go on: each of their keyframes waits .3 s at most, and after 3 s not at all."""
    queue = FrameSetQueue(FrameSetConfig(wait_s=0.3))
    queue.add(waiting(frame("right", 0), 0.0))
    waited = []
    with caplog.at_level(logging.INFO):
        for tenths in range(0, 60, 5):
            at_s = tenths / 10
            queue.add(waiting(frame("left", 100 * tenths), at_s))
            until_s = next(at_s + step / 20 for step in range(100) if take_all(queue, at_s + step / 20))
            waited.append(round(until_s - at_s, 2))
        assert max(waited) <= 0.35 and waited[6:] == [0.0] * 6
        assert len([each for each in caplog.records if "camera_is_missed" in each.getMessage()]) == 1
        assert "right" in caplog.text and "3 s" in caplog.text
        queue.add(waiting(frame("right", 6000), 6.0))
    assert "camera_is_back" in caplog.text


def test_frames_wait_until_captures_that_were_just_found_have_sent_something():
    queue = FrameSetQueue(FrameSetConfig())
    queue.add(waiting(frame("left", 100)))
    assert queue.take(0.5, complete=False) == [] and take_all(queue, 0.5) == [["left_100"]]


def test_what_has_no_camera_or_no_time_is_alone_and_waits_for_nobody():
    queue = FrameSetQueue(FrameSetConfig())
    for item in (frame("left", 100), frame("", 100), frame("right", None), DroppedFrame("x", "for the test")):
        queue.add(waiting(item))
    assert [each for each in take_all(queue, 0.1) if len(each) > 1] == []
    assert take_all(queue, 1.0) == [["left_100"]]


def test_what_another_recon_is_served_now_is_forgotten():
    queue, client = FrameSetQueue(FrameSetConfig()), SimpleNamespace(served=True)
    queue.add(waiting(frame("left", 100), client=client))
    client.served = False
    assert queue.take(1.0) == []


def test_a_frame_set_goes_into_the_map_together():
    inbox, stopping = Inbox(), threading.Event()
    keyframes = [ArrivedKeyframe(None, 0.0, number) for number in (0, 0, 0, 1, 1, 1)]  # pyright: ignore
    inbox.enqueue(keyframes[:3], stopping)
    inbox.enqueue(keyframes[3:], stopping)
    inbox.enqueue_now(RemovedFrame("x"))
    assert [getattr(each, "frame_set", None) for each in inbox.dequeue(0)] == [0, 0, 0, 1, 1, 1]
    stored = [SimpleNamespace(name=each.name, frame=each) for each in
              (frame("left", 0), frame("left", 100), frame("right", 5), frame("", 0), frame("right", 101))]  # fmt: skip
    again = number_frame_sets(stored, 0.02)
    names = [each.keyframe.frame.name for each in again]
    assert names == ["left_0", "right_5", "left_100", "right_101", "_0"]
    assert again[0].frame_set == again[1].frame_set != again[2].frame_set == again[3].frame_set
    assert again[4].frame_set is None


@pytest.fixture
def plain(monkeypatch):
    """Keyframes need no features."""
    monkeypatch.setattr(ingest, "prepare", lambda each, _: SimpleNamespace(name=each.name, frame=each))


@pytest.fixture
def servers(tmp_path, monkeypatch) -> Iterator[dict[str, KeyframeServer]]:
    """A capture for each of IDS, with a spool."""
    monkeypatch.setattr(ingest, "CONNECT_S", 30.0)  # a busy machine connects them one by one
    network, spool = Network(directory=tmp_path / "run"), SpoolConfig(directory=tmp_path / "state")
    with ExitStack() as resources:
        yield {each: resources.enter_context(KeyframeServer(network, Spool(spool, each), each)) for each in IDS}


def offer_sets(servers: dict[str, KeyframeServer], *ms: int) -> None:
    """Offers a frame of each capture, a millisecond after one another, at each of these times."""
    for at in ms:
        for offset, (camera_id, server) in enumerate(servers.items()):
            server.offer(frame(camera_id, at + offset))


def take_in(folder: Path, servers: dict[str, KeyframeServer], number: int) -> tuple[list, set[str]]:
    """Lets an intake take until no capture has a frame: the `number` events, and the names that are stored."""
    network, inbox, stopping = Network(directory=folder / "run"), Inbox(), threading.Event()
    found: list = []

    def come():
        for server in servers.values():
            server.serve(0.01)
        found.extend(inbox.dequeue(0))
        return len(found) == number and not any(server.num_queued for server in servers.values())

    with closing(Store(folder / "checkpoint")) as store:
        patient = FrameSetConfig(wait_s=30.0)
        intake = ingest.Intake(network, ReconstructionConfig(), store, inbox, Problems(), stopping, patient)
        thread = threading.Thread(target=intake.run)
        thread.start()
        try:
            wait_for(come, 30.0)
        finally:
            stopping.set()
            thread.join()
        return found, set(store.names)


def test_each_of_three_captures_gets_its_answers_and_their_frames_are_sets(tmp_path, plain, servers):
    network = Network(directory=tmp_path / "run")
    assert find_captures(network) == sorted(IDS)
    with pytest.raises(AlreadyRunning, match="capture.keyframes@left is offered .* camera_id of their own"):
        KeyframeServer(network, Spool(SpoolConfig(directory=tmp_path / "other"), "left"), "left")
    offer_sets(servers, 0, 200, 400)
    found, _ = take_in(tmp_path, servers, 9)
    assert [each.keyframe.name for each in found] == [
        f"{c}_{ms + i}" for ms in (0, 200, 400) for i, c in enumerate(IDS)
    ]
    assert [each.frame_set for each in found] == [0, 0, 0, 3, 3, 3, 6, 6, 6]
    assert {server.acknowledged for server in servers.values()} == {3}


def test_no_image_of_a_frame_set_is_acknowledged_before_all_are_stored(tmp_path, plain, monkeypatch, servers):
    """The disk takes the second of three images only the third time; what is odd of another set is refused alone."""
    monkeypatch.setattr(ingest, "RETRY_S", 0.05)
    real, failures, acknowledged = ledger.write_frame, [OSError(28, "No space left"), MemoryError()], []

    def write(path, key, one, following=0):
        acknowledged.append(sum(server.acknowledged for server in servers.values()))
        if one.name == "middle_1" and failures:
            raise failures.pop()
        if one.name == "left_200":
            raise ArithmeticError("odd")
        real(path, key, one, following)

    monkeypatch.setattr(checkpoint_store, "write_frame", write)
    offer_sets(servers, 0, 200)
    found, names = take_in(tmp_path, servers, 5)
    assert not failures and acknowledged[:7] == [0] * 7  # two times of two images, then all three
    assert [each.frame_set for each in found] == [0, 0, 0, 3, 3]
    assert [server.acknowledged for server in servers.values()] == [1, 2, 2]
    assert servers["left"].set_aside == 1 and names == {each.keyframe.name for each in found}


def make_daemon(store: Store, places=None) -> SimpleNamespace:
    """What of a daemon answers who takes a keyframe back."""
    places = places or SimpleNamespace(find_scenes=lambda name: [])
    worker = SimpleNamespace(
        _store=store, _recipe=ReconstructionConfig(), _output=SimpleNamespace(index=places),
        find_inactive_scenes=lambda name: Worker.find_inactive_scenes(worker, name),
        find_frame_set=lambda name: Worker.find_frame_set(worker, name),
    )  # fmt: skip
    daemon = SimpleNamespace(
        _store=store, _inbox=Inbox(), _worker=worker, _retract=lambda names: Daemon._retract(daemon, names)
    )
    return daemon


def test_a_keyframe_is_retracted_with_its_frame_set(tmp_path, monkeypatch):
    store = Store(tmp_path / "checkpoint")
    for number, each in enumerate([frame("left", 100), frame("right", 105), frame("left", 300), frame("", 100)]):
        store.add_frame(ReceivedFrame("0" * 32, number, each))
    node, ledgers = make_daemon(store), []
    real = checkpoint_store.write_ledger
    monkeypatch.setattr(checkpoint_store, "write_ledger", lambda *what: (ledgers.append(what), real(*what)))
    answer = Daemon._answer(node, RemoveKeyframe("right_105"))
    assert answer.done and answer.message.endswith("with it left_100, taken at the same time")
    assert store.names == {"left_300", "_100"}
    assert len(ledgers) == 1, "at once: no kill leaves half of it"
    assert node._inbox.dequeue(0) == [RemovedFrame("right_105"), RemovedFrame("left_100")], "at once"
    assert Daemon._answer(node, RemoveKeyframe("left_300")).message == (
        "left_300 is removed; the scene is built anew without it"
    )
    assert not Daemon._answer(node, RemoveKeyframe("right_105")).done
    store.close()


def test_a_frame_set_of_a_place_that_the_camera_has_left_is_retracted_as_one(tmp_path):
    store = Store(tmp_path / "checkpoint")
    store.add_frames([ReceivedFrame("0" * 32, number, frame(each, 100)) for number, each in enumerate(IDS)])
    store.leave_submap(3)
    store.close()
    at = Stamp(10**8, Clock.UTC)
    cameras = tuple(
        replace(make_camera(i), name=f"{each}_100", camera_id=each, captured_at=at) for i, each in enumerate(IDS)
    )
    write_files(tmp_path / "out" / "scene-0001", {"cameras.json": encode_cameras(cameras)})
    store = Store(tmp_path / "checkpoint")
    places = SubmapIndex(tmp_path / "out", store.identity)
    snapshot = replace(make_snapshot(), cameras=cameras)
    places.update(make_submap_record("scene-0001", SubmapState.LEFT, "scene-0001", snapshot, [], []))
    answer = Daemon._answer(make_daemon(store, places), RemoveKeyframe("middle_100"))
    assert answer.done and answer.message.endswith("with it left_100, right_100, taken at the same time")
    output = SimpleNamespace(index=places, complain=pytest.fail)
    left = InactiveSubmaps(store, ReconstructionConfig(), output, SimpleNamespace(remove_scene=lambda _: None))  # pyright: ignore
    left._remove_keyframes()
    assert store.ledger.retracted == ()
    with closing(Store(store.directory / "left" / "scene-0001")) as kept:
        assert kept.names == set() and len(kept.frames_dropped) == 3
    store.close()


class Node:
    """Three captures and the receiving half of recon, each a process that can be killed and started again."""

    def __init__(self, folder: Path, seconds: float) -> None:
        self.folder, self.until_s = folder, round(time.time() + seconds)
        install_camera(folder / "packages")
        self.environment = os.environ | {"PYTHONPATH": f"{folder / 'packages'}:{ROOT}"}
        self.processes: dict[str, subprocess.Popen] = {}
        for seed, each in enumerate(IDS):
            (folder / f"{each}.yaml").write_text(
                f"camera: {{kind: grid, until_s: {self.until_s}, seed: {seed}}}\n"
                "selection: {every_frame: true}\npreview: {per_second: 0}\n"
                f"spool: {{directory: {folder / 'state'}}}\nnetwork: {{directory: {folder / 'run'}}}\n"
            )

    def start(self, name: str) -> None:
        if name == "recon":
            command = ["-m", "tests.support.three_captures", str(self.folder / "run"), str(self.folder / "checkpoint")]
        else:
            command = ["-m", "splatnode", "capture", str(self.folder / f"{name}.yaml"), "--camera-id", name]
        with open(self.folder / f"{name}.log", "a") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, *command], cwd=ROOT, env=self.environment, stderr=log
            )

    def kill(self, name: str) -> None:
        self.processes[name].send_signal(signal.SIGKILL)
        self.processes[name].wait()

    def spooled(self) -> set[str]:
        """Names of the keyframes that the captures have promised to keep."""
        logs = "".join((self.folder / f"{each}.log").read_text() for each in IDS)
        return set(re.findall(r"event=keyframe name=(\S+_\d+)\s", logs))

    @property
    def is_drained(self) -> bool:
        return not list((self.folder / "state").glob("spool-*/*.frame"))


def test_three_captures_survive_a_kill_of_each_in_turn_and_lose_nothing(tmp_path):
    node, victims = Node(tmp_path, seconds=45.0), ("left", "recon", "middle", "right", "recon")
    for each in (*IDS, "recon"):
        node.start(each)
    try:
        wait_for(lambda: len(node.spooled()) >= 9)
        for victim in victims:
            before = len(node.spooled())
            node.kill(victim)
            node.start(victim)
            wait_for(lambda before=before: len(node.spooled()) >= before + 12)
        wait_for(lambda: time.time() > node.until_s + 1)
        wait_for(lambda: node.is_drained)
    finally:
        for process in node.processes.values():
            process.kill()
            process.wait()
    paths = sorted((tmp_path / "checkpoint" / "frames").glob("*.frame"))
    stored = [each for each in map(read_frame, paths) if each.frame.name.rpartition("_")[2].isdecimal()]
    assert len({each.key for each in stored}) == len(stored)  # none twice
    assert {each.frame.name for each in stored} >= node.spooled()  # none lost
    for camera_id in IDS:
        taken = [each.frame.captured_at.ns for each in stored if each.frame.camera_id == camera_id]
        assert taken == sorted(taken) and len(set(taken)) == len(taken) > 20
    sets = form_frame_sets([(each.frame.name, each.frame.camera_id, each.frame.captured_at) for each in stored])
    assert all(len({name.rpartition("_")[2] for name in each.names.values()}) == 1 for each in sets)
    assert len(sets) == len({each.frame.captured_at.ns // STEP_NS for each in stored})
    assert sum(len(each.names) == 3 for each in sets) > 20
