"""What is told of the live camera beside the finished scene: where it is, and when it was there."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from splatnode.capture.config import Config as PreviewConfig
from splatnode.capture.config import encode_preview
from splatnode.capture.frame import Clock, Frame, Stamp
from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import CAPTURE_PREVIEW
from splatnode.capture.messaging.pubsub import Publisher, Subscriber
from splatnode.capture.process.terminal import Problems
from splatnode.recon.daemon import relocalization
from splatnode.recon.daemon.relocalization import FinalScene, Watcher
from splatnode.recon.daemon.relocalization import TrackingConfig as Tracking
from tests.capture.messaging.test_sockets import ipc, tcp, wait_for

CAPTURED_AT = Stamp(1_714_989_607_250_000_001, Clock.UTC)


class Standing:
    """Finds the live camera where the scene's first one was."""

    def __init__(self, *_) -> None:
        pass

    def track(self, _, K):
        return SimpleNamespace(T_world_camera=np.eye(4), K=K), None


@contextmanager
def watching_a_scene(network, monkeypatch, tracker=Standing, problems=None):
    """A watcher in its thread."""
    monkeypatch.setattr(relocalization, "compute_landmarks", lambda *_: None)
    monkeypatch.setattr(relocalization, "Tracker", tracker)
    stopping = threading.Event()
    finished = FinalScene(SimpleNamespace(cameras=[SimpleNamespace(width=8, height=6, K=np.eye(3), lens=None)]), [])
    watching = Watcher(network, Tracking(interval_s=0.01), lambda: finished, problems or Problems(), stopping)
    thread = threading.Thread(target=watching.run)
    thread.start()
    try:
        yield watching
    finally:
        stopping.set()
        thread.join(30)


def sender_of(publisher):
    """What sends one more preview and returns its number."""
    frame = Frame(0, "0.png", 0, np.zeros((48, 64, 3), np.uint8), None, captured_at=CAPTURED_AT)
    numbering = Numbering()

    def send():
        publisher.send(*encode_preview(frame, numbering, PreviewConfig(), state="streaming", taken=True, reason=""))
        return numbering.sequence - 1

    return send


def test_the_live_camera_has_the_time_of_the_picture_in_which_it_was_found(tmp_path, monkeypatch):
    network = ipc(tmp_path)
    with watching_a_scene(network, monkeypatch) as watching, Publisher(CAPTURE_PREVIEW, network) as publisher:
        send = sender_of(publisher)
        tracked = wait_for(lambda: (send(), time.sleep(0.01), watching.tracked)[2])
    assert watching.tracked.captured_at == CAPTURED_AT and watching.tracked.name == "live", tracked


def test_the_newest_preview_is_tracked_however_long_the_one_before_took(tmp_path, monkeypatch):
    network, came, examined, go_on = ipc(tmp_path), [], [], threading.Event()
    count, decode = Subscriber._count, relocalization.decode_preview

    def counted(subscriber, header):
        came.append(header.sequence)
        count(subscriber, header)

    def decoded(message):
        examined.append(message.header.sequence)
        return decode(message)

    class Slow(Standing):
        def track(self, image, K):
            assert go_on.wait(60)
            return super().track(image, K)

    monkeypatch.setattr(Subscriber, "_count", counted)
    monkeypatch.setattr(relocalization, "decode_preview", decoded)
    with watching_a_scene(network, monkeypatch, Slow), Publisher(CAPTURE_PREVIEW, network) as publisher:
        send = sender_of(publisher)
        wait_for(lambda: (send(), time.sleep(0.01), examined)[2])
        deadline = time.monotonic() + 30
        for _ in range(20):
            last = [send() for _ in range(5)][-1]  # fewer than half of what the sender's queue holds: none is lost
            while last not in came and time.monotonic() < deadline:
                time.sleep(0.001)
        go_on.set()
        wait_for(lambda: len(examined) > 1)
    assert examined[1] > last - 5  # of the last five, of which some may just be coming


@pytest.mark.parametrize("damaged", [None, b"half of a ke"])
def test_a_key_that_is_missing_or_damaged_for_a_while_ends_no_thread(tmp_path, monkeypatch, damaged):
    monkeypatch.setattr(relocalization, "RETRY_S", 0.02)
    network, problems, tries = tcp(tmp_path), Problems(), []
    monkeypatch.setattr(relocalization, "Subscriber", lambda *args: (tries.append(args), Subscriber(*args))[1])
    with Publisher(CAPTURE_PREVIEW, network) as publisher:
        send, key = sender_of(publisher), network.keys / "secret.key"
        kept = key.rename(tmp_path / "kept.key")
        if damaged:
            key.write_bytes(damaged)
            key.chmod(0o600)
        with watching_a_scene(network, monkeypatch, problems=problems) as watching:
            wait_for(lambda: len(tries) > 3)
            assert str(problems).startswith("1 failures of the previews' connection, the last: KeyFileError")
            kept.rename(key)
            wait_for(lambda: (send(), time.sleep(0.01), watching.tracked)[2])
