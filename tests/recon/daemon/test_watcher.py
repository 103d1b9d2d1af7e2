"""What is told of the live camera beside the finished scene: where it is, and when it was there."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np

from splatnode.capture.frame import Frame
from splatnode.capture.messaging.broadcast import Publisher
from splatnode.capture.messaging.services import CAPTURE_PREVIEW
from splatnode.capture.messaging.wire import Numbering
from splatnode.capture.preview import Config as PreviewConfig
from splatnode.capture.preview import encode_preview
from splatnode.capture.process.problems import Problems
from splatnode.capture.stamp import Clock, Stamp
from splatnode.recon.daemon import watcher
from splatnode.recon.daemon.tracking import Config as Tracking
from splatnode.recon.daemon.watcher import Finished, Watcher
from tests.capture.messaging.test_sockets import ipc, wait_for

CAPTURED_AT = Stamp(1_714_989_607_250_000_001, Clock.UTC)


class Standing:
    """Finds the live camera where the scene's first one was."""

    def __init__(self, *_) -> None:
        pass

    def track(self, _, K):
        return SimpleNamespace(T_world_camera=np.eye(4), K=K), None


def test_the_live_camera_has_the_time_of_the_picture_in_which_it_was_found(tmp_path, monkeypatch):
    monkeypatch.setattr(watcher, "landmarks", lambda *_: None)
    monkeypatch.setattr(watcher, "Tracker", Standing)
    network, stopping, numbering = ipc(tmp_path), threading.Event(), Numbering()
    finished = Finished(SimpleNamespace(cameras=[SimpleNamespace(width=8, height=6, K=np.eye(3), lens=None)]), [])
    watching = Watcher(network, Tracking(every_s=0.01), lambda: finished, Problems(), stopping)
    thread = threading.Thread(target=watching.run)
    thread.start()
    frame = Frame(0, "0.png", 0, np.zeros((48, 64, 3), np.uint8), None, captured_at=CAPTURED_AT)
    with Publisher(CAPTURE_PREVIEW, network) as publisher:

        def found():
            publisher.send(*encode_preview(frame, numbering, PreviewConfig(), state="streaming", taken=True, reason=""))
            return watching.tracked

        tracked = wait_for(found)
    stopping.set()
    thread.join(30)
    assert watching.tracked.captured_at == CAPTURED_AT and watching.tracked.name == "live", tracked
