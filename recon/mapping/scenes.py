"""A map of a long recording: the node's own work, without a camera. All keyframes, in scenes of some views each.

The checkpoint lies in the result folder until the map is complete, so an interrupted run goes on where it was.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.process.system import is_shortage
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon import config as daemon
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.ingest import ArrivedKeyframe, Inbox, RemovedFrame
from splatnode.recon.daemon.worker import Worker
from splatnode.recon.preparation import prepare
from splatnode.recon.result.submap_index import FILE

log = logging.getLogger(__name__)

CHECKPOINT = "checkpoint"  # in the result folder
KEYFRAME_BYTES = 8_000_000  # on the disk, of its checkpoint and its results
NEVER_S = 1e9  # nobody sees provisional results
LOOK_S = 0.5  # between looks at how far the work is


@dataclass(frozen=True)
class MapProgress:
    """How far the map is."""

    taken: int  # keyframes
    judged: int  # scenes whose cameras are judged with all evidence
    unfinished: int  # places whose scenes are still to be made
    maps: int
    loops: int

    def __str__(self) -> str:
        work = f" ({self.unfinished} still to be made)" if self.unfinished else ""
        loops = f", places found again: {self.loops}" if self.loops else ""
        return f"scenes: {self.judged}{work}, maps: {self.maps}{loops}"


def check_incomplete(out: Path) -> None:
    """Raises ValueError where the folder holds a map that is complete."""
    if (out / FILE).exists() and not (out / CHECKPOINT).exists():
        raise ValueError(f"{out} holds the scenes of a map already; give another --out")


def make_node_config(config: ReconstructionConfig, out: Path) -> daemon.DaemonConfig:
    """Makes the configuration of a node that reconstructs as `config` says, and writes only into `out`."""
    return daemon.DaemonConfig(reconstruction=config, checkpoint=out / CHECKPOINT, out=out, export_interval_s=NEVER_S)


def make_scenes(
    frames: Iterable[Frame | DroppedFrame],
    identity: str,
    node: daemon.DaemonConfig,
    show: Callable[[MapProgress], None],
) -> None:
    """Writes the final scenes of all keyframes, and their places.json.

    `identity`, 32 hexadecimal digits, tells one recording from another. What an earlier run took in is not taken in
    again. Raises ValueError where the checkpoint is that of another recording, and CheckpointError.
    """
    stopping = threading.Event()
    assert node.checkpoint is not None
    with contextlib.closing(Store(node.checkpoint)) as store:
        if {session for session, _ in store.frame_keys} - {identity}:
            raise ValueError(f"{store.directory} is that of another recording; remove it, or give another --out")
        taken = max((sequence for _, sequence in store.frame_keys), default=-1) + 1
        inbox = Inbox()
        worker = Worker(node, store, inbox, lambda _: None, stopping)

        def tell(taken: int) -> None:
            show(MapProgress(taken, worker.map_counts[0], worker.num_unfinished, *worker.map_counts[1:]))

        with _run_worker(worker, stopping) as check:
            for sequence, frame in enumerate(frames):
                if sequence >= taken:
                    received = ReceivedFrame(identity, sequence, frame)
                    _enqueue_frame(received, node.reconstruction, store, inbox, stopping, check)
                    taken = sequence + 1
                    tell(taken)
            rests = worker.rests
            while worker.rests < rests + 2:  # the first of them may have begun before the last keyframe came
                check()
                tell(taken)
                time.sleep(LOOK_S)
            tell(taken)


def remove_checkpoint(out: Path) -> None:
    """The map is complete."""
    shutil.rmtree(out / CHECKPOINT, ignore_errors=True)


@contextlib.contextmanager
def _run_worker(worker: Worker, stopping: threading.Event) -> Iterator[Callable[[], None]]:
    """The worker in a thread of its own, which is stopped at the end; yields what raises the error that it ended by."""
    errors: list[BaseException] = []

    def run() -> None:
        try:
            worker.run()
        except BaseException as error:
            errors.append(error)
            stopping.set()

    def check() -> None:
        if errors:
            raise errors[0]

    thread = threading.Thread(target=run, name="Worker", daemon=True)
    thread.start()
    try:
        yield check
    finally:
        stopping.set()
        thread.join()


def _enqueue_frame(
    received: ReceivedFrame, config: ReconstructionConfig, store: Store, inbox: Inbox, stopping: threading.Event,
    check: Callable[[], None],
) -> None:  # fmt: skip
    """Waits while the worker has enough to do. A frame that cannot be used is recorded with the reason."""
    stored = store.add_frame(received)
    if stored is None:
        return
    name = stored.frame.name
    try:
        keyframe = prepare(stored.frame, config)
    except Exception as error:
        if is_shortage(error):
            raise
        log.warning("%s cannot be used: %s", name, error)
        store.forget(name, f"cannot be used: {error}")
        inbox.enqueue(RemovedFrame(name), stopping, check)
        return
    inbox.enqueue(ArrivedKeyframe(keyframe, time.monotonic()), stopping, check)
