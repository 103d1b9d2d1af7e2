"""`splatnode replay --map`: all keyframes of a long recording in one map; in several where nothing joins its parts.

It is the node's own work, without a camera, in scenes of some views each. The checkpoint lies in the result folder
until the map is complete, so an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.image_file import encode_png
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.process.records import record_in
from splatnode.capture.process.system import is_shortage
from splatnode.capture.process.terminal import ProgressStep, format_times, is_interactive, progress, say, show_progress
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon import config as daemon
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.ingest import ArrivedKeyframe, Inbox, RemovedFrame
from splatnode.recon.daemon.status import WorkProgress
from splatnode.recon.daemon.worker import Worker
from splatnode.recon.merging.command import EXIT_GOOD, EXIT_REFUSED, Reports, compute_gaussian_limit, write_maps
from splatnode.recon.preparation import prepare
from splatnode.recon.replay_source import IMAGES, ReplayRecording, Request, load_recording
from splatnode.recon.result.export import read_cameras, remove_result, write_files
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.folder import hold_result_folder
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
    work: WorkProgress | None = None  # that is under way

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
            show(MapProgress(taken, worker.map_counts[0], worker.num_unfinished, *worker.map_counts[1:], worker.work))

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


_OF_ONE_SCENE = ("views", "frames", "view", "budget_s", "baseline", "marker", "poses", "stereo", "rig")


def replay_map(args: argparse.Namespace, request: Request, config: ReconstructionConfig) -> int:
    """Writes the scenes, their places.json, a merged result for each map, and a report.json about all."""
    given = [f"--{name.replace('_', '-')}" for name in _OF_ONE_SCENE if getattr(args, name)]
    if given:
        raise ValueError(f"--map makes many scenes and does not go with what is about one: {', '.join(given)}")
    check_incomplete(args.out)
    with show_progress(quiet=args.json) as tell:
        source = load_recording(request, tell)
        tell(str(source.choice))
    began_s = time.monotonic()
    with hold_result_folder(args.out, KEYFRAME_BYTES * len(source.choice.names)):
        remove_result(args.out)  # of one scene, beside which nobody would find the map's
        frames = _write_frames(source, args.out) if source.photographs is None else source.frames()
        told = _ProgressPrinter(args.json, len(source.choice.names))
        with _limit_log_level():
            make_scenes(frames, source.identity(config), make_node_config(config, args.out), told)
        progress("")
        reports = write_maps(args.out, args.out, partial(compute_gaussian_limit, args), quiet=args.json)
        report = _make_report(source, args.out, reports, time.monotonic() - began_s)
        write_files(args.out, {"report.json": json_bytes(report)})
        remove_checkpoint(args.out)
    if args.json:
        print(json.dumps(report))
    else:
        _print_report(report, args.out)
    return EXIT_GOOD if reports else EXIT_REFUSED


@contextlib.contextmanager
def _limit_log_level() -> Iterator[None]:
    """Limits the log to warnings: each step of each scene would be too much."""
    log = logging.getLogger("splatnode")
    before = log.level
    log.setLevel(logging.WARNING)
    try:
        yield
    finally:
        log.setLevel(before)


class _ProgressPrinter:
    """Says how far the work is: on a terminal again and again, else whenever a scene is judged or made."""

    def __init__(self, quiet: bool, keyframes: int) -> None:
        self._quiet, self._keyframes, self._last = quiet, keyframes, (0, 0, 0)
        self._began_s = time.monotonic()

    def __call__(self, now: MapProgress) -> None:
        if self._quiet:
            return
        step = ProgressStep("making scenes", now.taken, self._keyframes, "keyframe")
        line = f"{step}; {now}"
        work = now.work if now.taken == self._keyframes else None  # before, more places may come
        rest = "" if work is None else f"; {ProgressStep(*msgspec.structs.astuple(work)).sentence}"
        progress(f"{line}{rest} ({format_times(step, time.monotonic() - self._began_s)})")
        if not is_interactive() and (now.judged, now.unfinished, now.maps) != self._last:
            self._last = now.judged, now.unfinished, now.maps
            say(f"{line}{rest}")


def _write_frames(source: ReplayRecording, out: Path) -> Iterator[Frame | DroppedFrame]:
    """The frames of a film, each of which is written into out/images, too."""
    for frame in source.frames():
        path = out / IMAGES / frame.name
        if isinstance(frame, Frame) and not path.exists():
            write_files(out, {f"{IMAGES}/{frame.name}": encode_png(frame.image)})
        yield frame


def _make_report(source: ReplayRecording, out: Path, reports: Reports, seconds: float) -> dict[str, object]:
    places = record_in(read_json_file(out / FILE), dict[str, Any])["places"]
    why = {each["name"]: each["reason"] for place in places for each in place["frames_dropped"]}
    why |= {name: f"{place['scene_id']}: {place['message']}" for place in places for name in place["frames_used"]}
    placed = {camera.name for name in reports for camera in read_cameras(out / name / "cameras.json")}
    left_out = [name for name in source.choice.names if name not in placed]
    return {
        "photographs": str(source.photographs or out / IMAGES),
        "selection": source.choice.record(),
        "keyframes_in_a_map": len(placed),
        "left_out": [{"name": name, "reason": why.get(name, "it is in no scene")} for name in left_out],
        "scenes": len(places),
        "maps": {
            name: {key: report[key] for key in ("verdict", "num_gaussians", "scenes")}
            for name, report in reports.items()
        },
        "seconds": seconds,
    }


def _print_report(report: dict[str, Any], out: Path) -> None:
    for each in report["left_out"]:
        say(f"left out: {each['name']}: {each['reason']}")
    say(f"{report['keyframes_in_a_map']} of {report['selection']['keyframes']} keyframes are in a map")
    say(f"{report['seconds']:.0f} s, {report['scenes']} scenes, {len(report['maps'])} maps")
    say(f"results: {out}/ (places.json, {', '.join(f'{name}/' for name in report['maps'])}, report.json)")
