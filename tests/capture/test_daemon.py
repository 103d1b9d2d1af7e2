"""The capture process as it is run: what it sends, says, survives and returns."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from importlib import import_module
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from splatnode.capture import keyframe_selection
from splatnode.capture.cameras import folder
from splatnode.capture.config import Camera, CaptureConfig, PreviewHeader, decode_preview
from splatnode.capture.daemon import CaptureSession, capture
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging.keyframe_queue import KeyframeClient, Spool, SpoolConfig
from splatnode.capture.messaging.messages import FrameHeader, Key, encode
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, CAPTURE_STATUS, Network
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.process.system import FailedAfterReady
from splatnode.capture.status import CaptureStatus, last_run, read_heartbeats
from tests.capture.messaging.test_sockets import wait_for
from tests.conftest import ROOT

NO_TORCH = """
import sys
sys.modules["torch"] = sys.modules["open3d"] = None
from splatnode import command_line
sys.exit(command_line.main())
"""


@pytest.fixture
def photographs(tmp_path):
    """Five different places, the third of them twice, and a file that is none."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for index in range(5):
        noise = np.random.default_rng(index).integers(0, 256, (30, 40, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{index}.png"), cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC))
    (folder / "2b.png").write_bytes((folder / "2.png").read_bytes())
    (folder / "9.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photograph")
    return folder


@pytest.fixture
def start(tmp_path, photographs):
    """Starts `splatnode capture`, and ends it after the test."""
    running = []

    def run(camera="", spool="", **environment):
        config = tmp_path / "capture.yaml"
        config.write_text(
            f"camera: {{kind: folder, folder: {photographs}, fps: 8, pace: recorded{camera}}}\n"
            "selection: {every_frame: true}\n"
            f"spool: {{{spool}directory: {tmp_path / 'state'}}}\n"
            f"network: {{directory: {tmp_path / 'run'}}}\n"
        )
        command = [sys.executable, "-c", NO_TORCH, "capture", str(config)]
        process = subprocess.Popen(
            command, cwd=ROOT, stderr=subprocess.PIPE, text=True, env={**os.environ, **environment}
        )
        running.append(process)
        return process

    yield run
    for process in running:
        process.kill()
        process.communicate()


def network(tmp_path):
    return Network(directory=tmp_path / "run")


def take_all(tmp_path, process):
    """Acts as recon until capture ends."""
    items = []
    with KeyframeClient(network(tmp_path)) as client:

        def ended():
            if (received := client.receive(0.05)) is not None:
                items.append(received.frame)
                client.acknowledge(received)
            return process.poll() is not None

        wait_for(ended)
    return items


def test_a_folder_from_its_first_frame_to_its_last_acknowledgement(tmp_path, photographs, start):
    process = start()
    with Subscriber(CAPTURE_STATUS, network(tmp_path), CaptureStatus) as heartbeats:
        status = wait_for(lambda: (it := heartbeats.latest(0.1)) and it.header.state == "finished" and it.header)
        assert status.keyframes == 5 and status.frames == 6 and status.dropped == 1 and status.unusable == 1
        assert status.waiting == 6 and not status.recon_connected and 10 < status.rss_mb < 1000
    items = take_all(tmp_path, process)
    assert [item.name for item in items] == ["0.png", "1.png", "2.png", "3.png", "4.png", "9.jpg"]
    stored = cv2.cvtColor(cv2.imread(str(photographs / "1.png")), cv2.COLOR_BGR2RGB)
    assert np.array_equal(items[1].image, stored) and items[1].stamp_ns == 125_000_000
    assert "truncated" in items[5].reason or "damaged" in items[5].reason
    assert process.returncode == 0
    log = process.stderr.read()
    assert log.count("event=keyframe") == 5 and 'reason="every frame is taken"' in log
    assert [path.name for path in (tmp_path / "state" / "spool").iterdir()] == ["lock"]


def test_sigterm_is_a_clean_end_and_what_waits_is_kept(tmp_path, start):
    process = start(", loops: 1000")
    spool = tmp_path / "state" / "spool"
    wait_for(lambda: spool.exists() and len(list(spool.glob("*.frame"))) >= 2)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0
    assert "Traceback" not in process.stderr.read()
    kept = sorted(path.name for path in spool.iterdir() if path.name != "lock")
    assert all(name.endswith(".frame") for name in kept) and len(kept) >= 2
    assert not list((tmp_path / "run").glob("*[!k]"))  # the sockets are gone


def test_a_killed_capture_is_continued_by_the_next(tmp_path, start):
    process = start()
    spool = tmp_path / "state" / "spool"
    wait_for(lambda: spool.exists() and len(list(spool.glob("*.frame"))) >= 2)
    process.kill()
    process.wait()
    items = take_all(tmp_path, start())
    names = [item.name for item in items]
    assert names[:2] == ["0.png", "1.png"] and names.count("0.png") == 2 and names[-1] == "9.jpg"


def test_the_second_capture_is_told_who_the_first_is(tmp_path, start):
    first = start(", loops: 1000")
    wait_for(lambda: (tmp_path / "run" / "capture.preview").exists())
    second = start()
    assert second.wait(60) == 75
    assert f"by process {first.pid}" in second.stderr.read()


def test_systemd_is_told(tmp_path, start):
    address = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(address))
        manager.settimeout(60)
        process = start(", loops: 1000", NOTIFY_SOCKET=str(address), WATCHDOG_USEC="400000")
        messages = []

        def streams():
            messages.append(manager.recv(1000).decode())
            return sum(message.startswith("WATCHDOG=1") for message in messages) >= 3 and "streaming: " in messages[-1]

        wait_for(streams)
        assert "READY=1" in messages
        process.send_signal(signal.SIGTERM)
        while messages[-1] != "STOPPING=1":
            messages.append(manager.recv(1000).decode())


def test_status_says_how_it_is(tmp_path, start):
    start(", loops: 1000")
    wait_for(lambda: list(tmp_path.glob("state/spool/*.frame")))
    command = [sys.executable, "-m", "splatnode", "status", "--json", "--config", str(tmp_path / "capture.yaml")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    found = json.loads(result.stdout)
    assert result.returncode == 75 and found["recon"] is None
    assert found["capture"]["state"] == "streaming" and found["capture"]["camera"] == "folder"


def test_a_full_spool_is_said_once_and_stops_nothing(tmp_path, start, photographs):
    process = start(", loops: 1000", spool="max_frames: 2, ")
    with (
        Subscriber(CAPTURE_PREVIEW, network(tmp_path), PreviewHeader) as previews,
        Subscriber(CAPTURE_STATUS, network(tmp_path), CaptureStatus) as heartbeats,
    ):
        status = wait_for(lambda: (beat := heartbeats.latest(0.1)) and beat.header.not_taken > 1 and beat.header)
        assert status.waiting == 2 and "is splatnode recon running" in status.why
        preview = wait_for(lambda: previews.latest(0.1))
        assert decode_preview(preview).shape == (240, 320, 3) and preview.header.name.endswith(".png")
    process.terminate()
    assert process.stderr.read().count("event=spool_full") == 1


def test_a_disk_that_may_not_hold_the_spool_is_told_at_the_start(tmp_path, start):
    process = start(", loops: 1000", spool=f"max_mb: {2**31 - 1}, ")
    with Subscriber(CAPTURE_STATUS, network(tmp_path), CaptureStatus) as heartbeats:
        status = wait_for(lambda: (beat := heartbeats.latest(0.1)) and beat.header)
    assert "further keyframes (spool.max_mb) may take" in status.why
    process.terminate()
    assert process.stderr.read().count("event=disk_space") == 1


def test_status_tells_what_was_refused_until_it_is_seen(tmp_path, start):
    """Also of the processes before, and after a restart."""
    state = tmp_path / "state"
    with contextlib.closing(Spool(SpoolConfig(directory=state))) as spool:
        for index in range(3):
            header = FrameHeader(session="0" * 32, sequence=index, mono_ns=0, frame_id=0, name=f"old{index}.png",
                                 stamp_ns=5 * 10**18, intrinsics=None)  # fmt: skip
            spool.store(Key("0" * 32, index), encode(header, [np.zeros((4, 4, 3), np.uint8)]))
    process = start(", loops: 1000")
    with KeyframeClient(network(tmp_path)) as client:
        wait_for(lambda: client.receive(0.05))  # a good one comes after those that are refused
    status = wait_for(
        lambda: (it := read_heartbeats(network(tmp_path), only="capture")["capture"]) and it["set_aside"] == 3 and it
    )
    assert [each["name"] for each in status["newest_set_aside"]] == ["old2.png", "old1.png", "old0.png"]
    assert "3 keyframes were set aside, the last: old2.png: refused by recon" in status["problem"]
    command = [sys.executable, "-m", "splatnode", "status", "--config", str(tmp_path / "capture.yaml")]
    told = subprocess.run([*command, "--acknowledge"], cwd=ROOT, capture_output=True, text=True)
    assert "old0.png: refused by recon" in told.stdout and "not told again" in told.stdout
    process.terminate()
    assert process.wait(60) == 0
    start(", loops: 1000")
    status = wait_for(lambda: read_heartbeats(network(tmp_path), only="capture")["capture"])
    assert status["set_aside"] == 3 and status["problem"] == ""


@pytest.mark.parametrize("what", ["offer", "examine", "preview"])
def test_one_frame_that_fails_costs_that_frame_alone(tmp_path, photographs, monkeypatch, what):
    failed = []

    def failing(do, error):
        def once(*args, **kwargs):
            if len(failed) < 2:
                failed.append(args)
                raise error
            return do(*args, **kwargs)

        return once

    target, error = {
        "offer": ("splatnode.capture.messaging.keyframe_queue.write_message", OSError(5, "Input/output error")),
        "examine": ("splatnode.capture.keyframe_selection.assess", ArithmeticError("for the test")),
        "preview": ("splatnode.capture.daemon.encode_preview", ArithmeticError("for the test")),
    }[what]
    module, name = target.rsplit(".", 1)
    monkeypatch.setattr(target, failing(getattr(import_module(module), name), error))
    config = CaptureConfig(
        camera=Camera("folder", folder.Config(folder=photographs)),
        selection=keyframe_selection.Config(every_frame=True),
        spool=SpoolConfig(directory=tmp_path / "state"),
        network=network(tmp_path),
    )
    items = []

    def recon():
        with KeyframeClient(network(tmp_path)) as client:
            while thread.is_alive():
                if (received := client.receive(0.05)) is not None:
                    items.append(received.frame.name)
                    client.acknowledge(received)

    thread = threading.Thread(target=capture, args=[config])
    thread.start()
    recon()
    thread.join()
    expected = {"offer": ["2.png", "3.png", "4.png", "9.jpg"]}
    assert len(failed) == 2 and len(items) >= 4
    assert items == expected.get(what, items) and items[-1] == "9.jpg"


def test_a_camera_that_fails_after_it_gave_frames_is_no_fault_of_the_configuration(tmp_path, photographs, monkeypatch):
    def fails(config):
        yield Frame(0, "a.png", 0, np.zeros((40, 40, 3), np.uint8), None)
        raise ValueError("half way")

    monkeypatch.setattr(folder, "stream", fails)
    config = CaptureConfig(
        camera=Camera("folder", folder.Config(folder=photographs)),
        spool=SpoolConfig(directory=tmp_path / "state"),
        network=network(tmp_path),
    )
    with pytest.raises(FailedAfterReady, match="half way"):
        capture(config)


def test_status_tells_a_capture_that_has_finished_from_one_that_is_silent(tmp_path, start):
    """Until another one begins."""
    command = [sys.executable, "-m", "splatnode", "status", "--config", str(tmp_path / "capture.yaml")]
    process = start()
    items = take_all(tmp_path, process)
    assert process.wait(60) == 0 and "event=started" in process.stderr.read()
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout
    keyframes = sum(isinstance(item, Frame) for item in items)
    assert re.search(
        rf"^capture: finished at \d\d:\d\d:\d\d: recon has answered all of its {keyframes} keyframes", told
    )
    assert "recon: nothing heard of it" in told
    start(", loops: 1000")
    wait_for(lambda: read_heartbeats(network(tmp_path), only="capture")["capture"])
    assert last_run(network(tmp_path)) is None


def test_a_capture_without_its_camera_never_says_that_it_started(tmp_path):
    config = tmp_path / "capture.yaml"
    config.write_text(
        f"camera: {{kind: v4l2, device: {tmp_path / 'no camera'}}}\n"
        f"spool: {{directory: {tmp_path / 'state'}}}\nnetwork: {{directory: {tmp_path / 'run'}}}\n"
    )
    command = [sys.executable, "-m", "splatnode", "capture", str(config)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 69 and "no camera at" in done.stderr and "event=started" not in done.stderr


@pytest.mark.parametrize(
    ("live", "waiting", "told"),
    [(False, 0, True), (False, 99, True), (False, 100, False), (True, 0, False)],
    ids=["a photograph", "some wait", "many wait", "a live camera's frame"],
)
def test_what_the_camera_could_not_give_takes_no_room_of_keyframes(live, waiting, told):
    offered: list[DroppedFrame] = []
    session = SimpleNamespace(
        dropped=0,
        config=SimpleNamespace(camera=SimpleNamespace(module=SimpleNamespace(LIVE=live)), spool=SpoolConfig()),
        _server=SimpleNamespace(num_queued=waiting),
        _deliver=offered.append,
    )
    damaged = DroppedFrame("3.jpg", "the driver says that it is damaged")
    CaptureSession.drop(session, damaged)
    assert session.dropped == 1 and offered == ([damaged] if told else [])
