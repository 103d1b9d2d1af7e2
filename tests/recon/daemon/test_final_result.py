"""A finished scene that the disk does not take is written when there is room again."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from splatnode.capture.messaging.pubsub import Answer
from splatnode.recon.daemon import submap, worker
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.ingest import CAPACITY, Inbox, RemovedFrame
from splatnode.recon.daemon.node import Daemon, RemoveKeyframe
from splatnode.recon.daemon.submap import AGAIN_S, FinalResult

FINAL = SimpleNamespace(final=True)
WORK = SimpleNamespace(names=["a.png", "b.png"])


class Disk:
    """In place of the outputs: takes what is written, or not."""

    def __init__(self) -> None:
        self.full, self.exported, self.saved = True, 0, []

    def export(self, *_) -> bool:
        self.exported += not self.full
        return not self.full

    def save(self, _, __, final: bool) -> None:
        self.saved.append(final)


@pytest.fixture
def clock(monkeypatch):
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(submap, "time", SimpleNamespace(monotonic=lambda: now.s))
    return now


def test_what_the_disk_refused_is_written_once_it_takes_it(clock):
    disk = Disk()
    result = FinalResult(SimpleNamespace(names={"a.png", "b.png"}), disk)
    assert not result.write(FINAL, WORK) and not result.names
    disk.full = False
    assert not result.retry_write(FINAL, WORK, at_once=False)  # it was tried just now
    clock.s += AGAIN_S
    assert result.retry_write(FINAL, WORK, at_once=False)
    assert result.names == set(WORK.names) and disk.saved == [False, True]
    clock.s += AGAIN_S
    assert not result.retry_write(FINAL, WORK, at_once=True) and disk.exported == 1


def test_at_the_end_it_is_tried_at_once_and_what_is_not_final_is_left_alone(clock):
    disk = Disk()
    result = FinalResult(SimpleNamespace(names={"a.png", "b.png"}), disk)
    result.write(FINAL, WORK)
    disk.full = False
    for shown in (None, SimpleNamespace(final=False)):
        assert not result.retry_write(shown, WORK, at_once=True)
    assert result.retry_write(FINAL, WORK, at_once=True)


@pytest.fixture
def working(tmp_path, monkeypatch):
    place = SimpleNamespace(settled=True, owed=[], failures=[])

    def take_in(arrived):
        if place.failures:
            raise place.failures.pop()
        place.owed, place.settled = [], True

    place.add_keyframes = take_in
    monkeypatch.setattr(worker, "ActiveSubmap", lambda *_: place)
    node = worker.Worker(
        DaemonConfig(out=tmp_path / "out"), Store(tmp_path / "store"), Inbox(), lambda _: None, threading.Event()
    )
    return node, place


@pytest.mark.parametrize(
    ("error", "again", "said"),
    [
        (OSError(28, "No space left on device"), True, "make room on the disk. What failed is tried again"),
        (MemoryError(), True, "What failed is tried again"),
        (ValueError("odd"), False, "ValueError: odd"),
    ],
)
def test_a_step_that_memory_or_disk_did_not_suffice_for_is_tried_again(working, error, again, said):
    node, place = working
    place.failures = [error]
    node._run_step(lambda: place.add_keyframes(["a keyframe"]))
    assert place.settled is not again and node.problem.endswith(said)
    node._run_step(lambda: place.add_keyframes([]))
    assert bool(node.problem) is not again


def test_who_takes_a_keyframe_back_does_not_wait_for_the_work():
    inbox, forgotten = Inbox(), []
    for index in range(CAPACITY):
        inbox.enqueue([RemovedFrame(str(index))], threading.Event())
    daemon = SimpleNamespace(
        _worker=SimpleNamespace(find_inactive_scenes=lambda _: [], find_frame_set=lambda name: [name]),
        _store=SimpleNamespace(names={"a.png"}, forget_frames=lambda *what: forgotten.append(what)),
        _inbox=inbox,
        _stopping=threading.Event(),
        _retract=lambda names: Daemon._retract(daemon, names),
    )
    answers: list[Answer] = []
    asking = threading.Thread(
        target=lambda: answers.append(Daemon._answer(daemon, RemoveKeyframe("a.png"))), daemon=True
    )
    asking.start()
    asking.join(60)
    assert answers and answers[0].done and forgotten == [(["a.png"], "retracted", [])]
    assert len(inbox) == CAPACITY + 1
