"""The daemon's threads survive any single input, and say so until somebody has seen it."""

from __future__ import annotations

import contextlib
import threading
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from splatnode.capture.config import Config as PreviewConfig
from splatnode.capture.config import encode_preview
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging import network as keys
from splatnode.capture.messaging.keyframe_queue import KeyframeClient, KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.messages import FrameHeader, Key, Numbering, encode
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, RECON_CONTROL
from splatnode.capture.messaging.pubsub import Answer, MarkProblemsSeen, Publisher, ask
from splatnode.capture.process.terminal import Problems
from splatnode.capture.status import read_heartbeats
from splatnode.recon.config import ReconstructionConfig as Reconstruction
from splatnode.recon.daemon import checkpoint, ingest, relocalization
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ingest import ArrivedKeyframe, Inbox, Intake, RemovedFrame
from splatnode.recon.daemon.node import RemoveKeyframe
from splatnode.recon.daemon.relocalization import FinalScene, Watcher
from splatnode.recon.daemon.relocalization import TrackingConfig as Tracking
from tests.capture.messaging.test_sockets import ipc, tcp, wait_for
from tests.recon.daemon.test_daemon import config, peer, running  # noqa: F401
from tests.support.synthetic import photographs

IMAGE = np.zeros((6, 8, 3), np.uint8)


def frame(index: int, name: str = "") -> Frame:
    return Frame(index, name or f"{index}.png", index, IMAGE, None)


def refused(sequence: int) -> tuple[Key, list]:
    """A message that an earlier splatnode spooled."""
    session = "0" * 32
    header = FrameHeader(
        session=session, sequence=sequence, mono_ns=0, frame_id=0, name=f"old{sequence}.png", stamp_ns=5 * 10**18,
        intrinsics=None,
    )  # fmt: skip
    return Key(session, sequence), encode(header, [IMAGE])


class Taking:
    """An intake in its thread, and capture's end."""

    def __init__(self, network, folder) -> None:
        self.server = KeyframeServer(network, Spool(SpoolConfig(directory=folder / "state")))
        self.store, self.inbox, self.problems = Store(folder / "checkpoint"), Inbox(), Problems()
        self.stopping = threading.Event()
        self.intake = Intake(network, Reconstruction(), self.store, self.inbox, self.problems, self.stopping)
        self.thread = threading.Thread(target=self.intake.run)

    def until(self, condition) -> None:
        wait_for(lambda: self.server.serve(0.01) or condition())

    def events(self, count: int) -> list:
        found = []

        def come():
            self.server.serve(0.01)
            found.extend(self.inbox.dequeue(0))
            return len(found) >= count

        wait_for(come)
        return found


@contextmanager
def taking(network, folder, first=None):
    """`first`: a recon that is served before."""
    opened = Taking(network, folder)
    if first is not None:
        opened.until(lambda: first.receive(0.01) or first.served)
    opened.thread.start()
    try:
        yield opened
    finally:
        opened.stopping.set()
        opened.thread.join(30)
        opened.server.close()
        opened.store.close()
    assert not opened.thread.is_alive()


@pytest.fixture
def plain(monkeypatch):
    """Keyframes need no features."""
    monkeypatch.setattr(ingest, "prepare", lambda frame, _: SimpleNamespace(name=frame.name))


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(ingest, "RETRY_S", 0.05)
    monkeypatch.setattr(relocalization, "RETRY_S", 0.05)


def test_a_disk_that_fails_for_a_while_costs_nothing(tmp_path, monkeypatch, plain, impatient):
    with taking(ipc(tmp_path), tmp_path) as node:
        put, failures = node.store.add_frames, [OSError(28, "No space left"), OSError(5, "Input/output error")]
        monkeypatch.setattr(
            node.store, "add_frames", lambda together: _raise(failures.pop()) if failures else put(together)
        )
        node.server.offer(frame(0))
        node.until(lambda: node.server.acknowledged == 1)
        assert node.store.names == {"0.png"} and not failures and node.intake.full == ""


def test_what_cannot_be_stored_is_refused_and_told_until_seen(tmp_path, monkeypatch, plain):
    with taking(ipc(tmp_path), tmp_path) as node:
        put = node.store.add_frames
        monkeypatch.setattr(
            node.store,
            "add_frames",
            lambda together: _raise(ArithmeticError("odd")) if together[0].frame.name == "0.png" else put(together),
        )
        node.server.offer(frame(0))
        node.server.offer(frame(1))
        node.until(lambda: node.server.acknowledged == node.server.set_aside == 1)
        assert node.store.names == {"1.png"}
        assert "ArithmeticError: odd" in node.server.spool.quarantine.newest(1)[0].reason
        node.until(lambda: "1 keyframes that were refused, the last: it cannot be stored" in str(node.problems))


def test_what_cannot_be_used_is_left_out_also_where_the_checkpoint_cannot_be_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(ingest, "prepare", lambda *_: _raise(ArithmeticError("for the test")))
    with taking(ipc(tmp_path), tmp_path) as node:
        monkeypatch.setattr(node.store, "forget", lambda *_: _raise(OSError(30, "Read-only file system")))
        for index in range(3):
            node.server.offer(frame(index))
        assert node.events(3) == [RemovedFrame(f"{index}.png") for index in range(3)]
        assert "3 keyframes that cannot be used, the last: 2.png: for the test" in str(node.problems)


def test_what_the_camera_could_not_give_is_remembered_and_disturbs_no_scene(tmp_path, plain):
    with taking(ipc(tmp_path), tmp_path) as node:
        node.server.offer(DroppedFrame("blurred.png", "blurred"))
        node.server.offer(frame(0))
        (arrived,) = node.events(1)
        assert arrived.keyframe.name == "0.png" and node.store.frames_dropped == [
            DroppedFrame("blurred.png", "blurred")
        ]


def test_what_there_is_no_memory_for_waits_until_there_is(tmp_path, monkeypatch, plain, impatient):
    with taking(ipc(tmp_path), tmp_path) as node:
        for module, what in ((node.store, "add_frames"), (ingest, "prepare")):
            real, failures = getattr(module, what), [MemoryError(), RuntimeError("can't allocate memory")]

            def short(*args, real=real, failures=failures):
                return _raise(failures.pop()) if failures else real(*args)

            monkeypatch.setattr(module, what, short)
        node.server.offer(frame(0))
        (arrived,) = node.events(1)
        assert arrived.keyframe.name == "0.png" and node.intake.full == "" and node.server.set_aside == 0


def test_two_frames_of_one_name_and_names_that_look_like_ours(tmp_path, plain):
    long = "n" * 255
    names = ["a", "000003-a", "000001-a", "a", "a", long, long, "000007-" + "n" * 248, long]
    with taking(ipc(tmp_path), tmp_path) as node:
        for index, name in enumerate(names):
            node.server.offer(frame(index, name))
        taken = [each.keyframe.name for each in node.events(len(names)) if isinstance(each, ArrivedKeyframe)]
        assert len(set(taken)) == len(names) and max(map(len, taken)) == 255
        assert node.store.names == set(taken)


def test_another_recon_is_told_that_it_is_not_served(tmp_path, plain):
    network = ipc(tmp_path)
    with taking(network, tmp_path) as node, KeyframeClient(network) as other:
        node.until(lambda: node.server.is_connected)
        wait_for(lambda: node.server.serve(0.01) or other.receive(0.01) or other.served is False)
        node.server.offer(frame(0))
        node.until(lambda: node.server.acknowledged == 1)
        assert other.receive(0.2) is None


def test_an_intake_that_is_not_served_says_so(tmp_path, plain):
    network = ipc(tmp_path)
    with KeyframeClient(network) as first, taking(network, tmp_path, first=first) as node:
        node.until(lambda: first.receive(0.01) or node.intake.unconnected == ingest.ANOTHER_IS_SERVED)
        assert first.served


def test_a_wrong_key_is_a_problem_until_it_is_put_right(tmp_path, plain, impatient):
    network = tcp(tmp_path)
    other = tmp_path / "other keys"
    keys.create_keys(other)
    keys.expect_server(network.keys, (other / "public.key").read_bytes())
    with taking(network, tmp_path) as node:
        node.server.offer(frame(0))
        node.until(lambda: "does not have the key" in node.intake.unconnected)
        keys.expect_server(network.keys, (network.keys / "public.key").read_bytes())
        node.until(lambda: node.server.acknowledged == 1)
        node.until(lambda: node.intake.unconnected == "")


@pytest.mark.parametrize("where", ["landmarks", "track"])
def test_a_preview_that_makes_tracking_fail_is_one_preview(tmp_path, monkeypatch, where):
    network, problems, stopping, tracked = ipc(tmp_path), Problems(), threading.Event(), []

    class Failing:
        def __init__(self, *_) -> None:
            pass

        def track(self, image, _):
            tracked.append(image.shape)
            raise ArithmeticError("for the test")

    monkeypatch.setattr(
        relocalization,
        "compute_landmarks",
        lambda *_: _raise(IndexError("none")) if where == "landmarks" else None,
    )
    monkeypatch.setattr(relocalization, "Tracker", Failing)
    camera = SimpleNamespace(width=8, height=6, K=np.eye(3), lens=None)
    finished = FinalScene(SimpleNamespace(cameras=[camera]), [])
    watching = Watcher(network, Tracking(interval_s=0.01), lambda: finished, problems, stopping)
    thread = threading.Thread(target=watching.run)
    thread.start()
    numbering = Numbering()
    with Publisher(CAPTURE_PREVIEW, network) as publisher:

        def failed():
            message = encode_preview(frame(0), numbering, PreviewConfig(), state="streaming", taken=True, reason="")
            publisher.send(*message)
            return str(problems)[:1].isdigit() and int(str(problems).split()[0]) >= 3

        wait_for(failed)
    assert thread.is_alive() and bool(tracked) == (where == "track")
    stopping.set()
    thread.join(30)


def test_a_stored_frame_that_cannot_be_used_costs_no_other(tmp_path, monkeypatch):
    store = Store(tmp_path / "checkpoint")
    prepare = checkpoint.prepare
    with KeyframeServer(ipc(tmp_path), Spool(SpoolConfig(directory=tmp_path / "state"))):
        for index in range(3):
            store.add_frame(SimpleNamespace(session="0" * 32, sequence=index, frame=frame(index)))
    store.close()
    monkeypatch.setattr(
        checkpoint,
        "prepare",
        lambda each, *rest: _raise(ArithmeticError()) if each.name == "1.png" else prepare(each, *rest),
    )
    store = Store(tmp_path / "checkpoint")
    restored = checkpoint.restore(store, Reconstruction())
    assert [keyframe.name for keyframe in restored.new] == ["0.png", "2.png"]
    assert store.names == {"0.png", "2.png"} and store.frames_dropped[0].name == "1.png"
    store.close()


def test_while_a_checkpoint_is_loaded_the_status_says_so(config, monkeypatch):  # noqa: F811
    with contextlib.closing(Store(config.checkpoint)) as store:
        for index in range(2):
            store.add_frame(SimpleNamespace(session="0" * 32, sequence=index, frame=frame(index)))
    restore, go_on = checkpoint.restore, threading.Event()
    monkeypatch.setattr(checkpoint, "restore", lambda *given: go_on.wait(60) and restore(*given))
    with running(config):
        status = wait_for(lambda: read_heartbeats(config.network, only="recon")["recon"])
        assert (status["state"], status["delay"]) == ("loading", "2 keyframes are being loaded")
        go_on.set()
        wait_for(lambda: read_heartbeats(config.network, only="recon")["recon"]["state"] != "loading")


def test_a_checkpoint_that_there_is_no_memory_for_is_left_as_it_is(tmp_path, monkeypatch):
    store = Store(tmp_path / "checkpoint")
    store.add_frame(SimpleNamespace(session="0" * 32, sequence=0, frame=frame(0)))
    store.close()
    monkeypatch.setattr(checkpoint, "prepare", lambda *_: _raise(MemoryError()))
    store = Store(tmp_path / "checkpoint")
    with pytest.raises(MemoryError):
        checkpoint.restore(store, Reconstruction())
    assert store.names == {"0.png"} and not store.frames_dropped
    store.close()


def test_the_running_daemon_tells_what_was_refused_and_answers_what_fails(config, peer, monkeypatch):  # noqa: F811
    with running(config):
        for index in range(8):
            peer.server.spool.store(*refused(index))
        (taken,) = photographs()[:1]
        peer.server.offer(taken)
        peer.wait_for_acknowledgements()
        assert peer.server.set_aside == 8 and peer.server.acknowledged == 1

        def problem() -> str:
            return read_heartbeats(config.network, only="recon")["recon"]["problem"]

        wait_for(lambda: "8 keyframes that were refused" in problem())
        assert ask(RECON_CONTROL, config.network, MarkProblemsSeen(), Answer).done
        wait_for(lambda: problem() == "")
        monkeypatch.setattr(Store, "forget_frames", lambda *_: _raise(OSError(30, "Read-only file system")))
        answer = ask(RECON_CONTROL, config.network, RemoveKeyframe(taken.name), Answer)
        assert not answer.done and "Read-only" in answer.message
        monkeypatch.setattr("shutil.disk_usage", lambda _: _raise(OSError(5, "Input/output error")))
        wait_for(lambda: "does not tell how much is free" in problem())


def _raise(error: BaseException):
    raise error
