"""Want of memory, threads and files: nobody's fault, told from faults, and outlasted. No frame and no keyframe is lost.

The limit on open files is this process's own, lowered for a moment.
"""

from __future__ import annotations

import contextlib
import errno
import threading
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import zmq

from splatnode.capture import daemon, keyframe_selection
from splatnode.capture.cameras import folder, watched
from splatnode.capture.config import Camera, CaptureConfig
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.image_header import UnusableImage
from splatnode.capture.messaging.keyframe_queue import KeyframeClient, KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.network import AllowList, Network, allow, create_keys
from splatnode.capture.process import python, system
from splatnode.capture.process.system import is_shortage, may_be_shortage, outlast
from splatnode.capture.process.terminal import Unfailing
from splatnode.capture.reader import ReaderState
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ledger import read_ledger
from tests.capture.messaging.test_sockets import wait_for
from tests.support.starved import no_file, starved

SECONDS = 0.3  # without files


@contextlib.contextmanager
def for_a_while():
    """No file can be opened for a moment, which another thread ends."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(starved())
        timer = threading.Timer(SECONDS, stack.close)
        timer.start()
        try:
            yield
        finally:
            timer.join()


def frame(index: int = 0) -> Frame:
    noise = np.random.default_rng(index).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    return Frame(index, f"{index}.png", index * 10**9, noise, None)


def photographs(place, count: int = 3) -> None:
    for index in range(count):
        cv2.imwrite(str(place / f"{index}.png"), frame(index).image)


def test_what_the_process_lacks_is_told_from_what_is_broken():
    caused, refused = ValueError("damaged"), ValueError("cannot be read")
    caused.__cause__, refused.__cause__ = no_file(), MemoryError()
    lacking = [OSError(each, "") for each in (errno.EMFILE, errno.ENFILE, errno.ENOMEM)]
    for error in (*lacking, zmq.ZMQError(errno.EMFILE), MemoryError(), RuntimeError("can't start new thread"), caused):
        assert is_shortage(error), error
    for error in (OSError(errno.EIO, "broken"), FileNotFoundError(errno.ENOENT, ""), ValueError("bad_alloc.png")):
        assert not is_shortage(error) and not may_be_shortage(error), error
    assert may_be_shortage(refused) and not is_shortage(refused)  # a stranger's file may ask for too much


def test_a_shortage_is_outlasted_and_said_once(caplog, monkeypatch):
    errors = [no_file(), MemoryError(), no_file()]

    def work() -> str:
        if errors:
            raise errors.pop()
        return "done"

    assert outlast(work, "photo.png") == "done" and len(caplog.records) == 1
    with pytest.raises(OSError, match="broken"):
        outlast(lambda: (_ for _ in ()).throw(OSError(errno.EIO, "broken")), "photo.png")
    monkeypatch.setattr(system, "_MEMORY_S", 0.1)
    with pytest.raises(MemoryError):
        outlast(lambda: (_ for _ in ()).throw(MemoryError()), "photo.png")


def test_a_folder_gives_every_photograph_though_no_file_can_be_opened_for_a_while(tmp_path):
    photographs(tmp_path)
    stream = folder.stream(folder.Config(folder=tmp_path))
    with for_a_while():
        items = list(stream)
    assert [type(item) for item in items] == [Frame] * 3, items


def test_a_watched_folder_gives_up_no_photograph_for_want_of_files(tmp_path):
    photographs(tmp_path)
    config = watched.Config(tmp_path, poll_s=0.01, stable_s=0.02, file_timeout_s=0.05)
    stream = watched.stream(config)
    with for_a_while():
        items = [next(stream) for _ in range(3)]
    assert all(isinstance(item, Frame) for item in items), items


def test_a_photograph_that_asks_for_too_much_memory_is_dropped_in_the_end(tmp_path, monkeypatch):
    photographs(tmp_path, 2)
    monkeypatch.setattr(system, "_MEMORY_S", 0.1)

    def greedy(data, *_):
        raise UnusableImage("damaged") from MemoryError()

    monkeypatch.setattr(folder, "decode_any_image", greedy)
    items = list(folder.stream(folder.Config(folder=tmp_path)))
    assert [type(item) for item in items] == [DroppedFrame] * 2


def test_a_keyframe_waits_in_the_spool_and_is_never_set_aside(tmp_path):
    network, spool = Network(directory=tmp_path / "run"), Spool(SpoolConfig(directory=tmp_path))
    with KeyframeServer(network, spool) as server, KeyframeClient(network) as client:
        keys = [server.offer(frame(index)) for index in range(2)]
        wait_for(lambda: client.receive(0.01) or server.serve(0.01) or server.is_connected)
        with starved():
            for _ in range(20):
                server.serve(0.01)
            with pytest.raises(OSError) as raised:
                server.offer(frame(2))
        assert is_shortage(raised.value) and list(spool) == keys
        assert not server.set_aside and not len(spool.quarantine)
        received = []
        wait_for(
            lambda: server.serve(0.01) or received.extend(filter(None, [client.receive(0.01)])) or len(received) > 1
        )


def test_what_lies_on_the_disk_is_not_broken_because_it_cannot_be_opened(tmp_path):
    with contextlib.closing(Spool(SpoolConfig(directory=tmp_path))) as spool:
        network = Network(directory=tmp_path / "run")
        with KeyframeServer(network, spool) as server:
            server.offer(frame())
    store = Store(tmp_path / "checkpoint")
    store.close()
    stored = next((tmp_path / "spool").glob("*.frame"))
    spool._files.clear()
    with starved():
        with pytest.raises(OSError):
            spool._take_over(stored)
        with pytest.raises(OSError):
            read_ledger(tmp_path / "checkpoint")
    assert stored.exists()


def test_a_key_is_let_in_though_its_file_cannot_be_opened_for_a_moment(tmp_path):
    own, other = create_keys(tmp_path), zmq.curve_keypair()[0]
    allow(tmp_path, "laptop", other)
    with for_a_while():
        assert AllowList(tmp_path / "allowed", own).callback("", other)


def test_no_further_process_is_a_shortage(monkeypatch):
    def none(*_, **__):
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(python.subprocess, "Popen", none)
    with pytest.raises(OSError) as raised:
        python.answer("json", b"", 10)
    assert is_shortage(raised.value)


def test_the_memory_is_told_as_unknown_where_it_cannot_be_read(caplog):
    system._say_unknown.cache_clear()
    with starved():
        assert system.resident_mb() == system.resident_mb() == 0.0
    assert len(caplog.records) == 1 and system.resident_mb() > 0


def test_what_is_done_again_and_again_ends_nothing_and_says_once_why(caplog):
    heart, fails = Unfailing("the heartbeat"), [True]

    def beat() -> None:
        if fails[0]:
            raise MemoryError

    assert [heart.do(beat) for _ in range(3)] == [False] * 3 and len(caplog.records) == 1
    fails[0] = False
    assert heart.do(beat)
    fails[0] = True
    assert not heart.do(beat) and len(caplog.records) == 2


@contextlib.contextmanager
def capturing(place):
    """A capture's session of a recording."""
    network, camera = Network(directory=place / "run"), Camera("folder", folder.Config(folder=place))
    config = CaptureConfig(camera, network=network, selection=keyframe_selection.Config(every_frame=True))
    with contextlib.ExitStack() as resources:
        server = resources.enter_context(KeyframeServer(network, Spool(SpoolConfig(directory=place))))
        yield daemon.CaptureSession(config, server, resources)


def test_capture_keeps_a_frame_that_cannot_be_written_for_want_of_files(tmp_path):
    with capturing(tmp_path) as session:
        with starved():
            session.handle(frame(), ReaderState.STREAMING)
            assert session.is_waiting and session.waits(0.01) and session.not_taken == 0
        assert not session.waits(0.01) and not session.is_waiting
        assert session.keyframes == session.frames == session._server.num_queued == 1


def test_capture_keeps_a_frame_that_memory_lacks_for(tmp_path, monkeypatch):
    with capturing(tmp_path) as session:
        with monkeypatch.context() as short:
            short.setattr(keyframe_selection, "assess", lambda image: (_ for _ in ()).throw(MemoryError()))
            session.handle(frame(), ReaderState.STREAMING)
            assert session.waits(0.01) and session.frames == 0
        assert not session.waits(0.01) and session.keyframes == session.frames == 1


def test_a_heartbeat_that_cannot_be_made_ends_nothing(tmp_path, monkeypatch):
    with capturing(tmp_path) as session:
        reader = SimpleNamespace(state=ReaderState.STREAMING, why="", skipped=0)
        sent = []
        monkeypatch.setattr(session._heartbeats, "send", sent.append)
        with starved():
            session.send_heartbeat(reader)
        assert sent[0].rss_mb == 0
        session._next_beat = 0
        monkeypatch.setattr(daemon, "resident_mb", lambda: (_ for _ in ()).throw(MemoryError()))
        session.send_heartbeat(reader)
        assert len(sent) == 1
