"""The verbs of the command line that reconstruct.

What a reconstruction will take is told before it begins, roughly: by what the built-in capture took, with as many
views.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import logging
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.image_file import encode_png
from splatnode.capture.keyframe_selection import THINNED, group_frame_sets
from splatnode.capture.lenses import Lenses, read_lenses
from splatnode.capture.messaging.messages import Numbering, ReceivedFrame
from splatnode.capture.messaging.network import RECON_DEPTH, RECON_SCENE, Network
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.capture.pose_files import Trajectory, poses_of, read_poses
from splatnode.capture.process import python
from splatnode.capture.process.config import read_yaml, record_in
from splatnode.capture.process.system import is_shortage
from splatnode.capture.process.terminal import (
    ProgressStep,
    Tell,
    format_times,
    is_interactive,
    progress,
    say,
    show_progress,
)
from splatnode.capture.rig import Rig, read_rig
from splatnode.recon.config import ReconstructionConfig, apply_changes, preset
from splatnode.recon.daemon import WorkProgress
from splatnode.recon.daemon import config as daemon
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ingest import ArrivedKeyframe, Event, Inbox, RemovedFrame
from splatnode.recon.daemon.worker import Worker
from splatnode.recon.estimation import prepare
from splatnode.recon.merging import Reports, compute_gaussian_limit, write_maps
from splatnode.recon.metric.arguments import collect_drift_changes, collect_metric_changes, trusts_poses
from splatnode.recon.metric.metres import Evidence, check_frame
from splatnode.recon.metric.stereo import make_pairs, stream_right_images
from splatnode.recon.pipeline import check_baseline, ignore_snapshot, reconstruct_source, set_preview_interval
from splatnode.recon.replay_source import (
    IMAGES,
    ReplayRecording,
    Request,
    Source,
    add_depth_folder,
    add_poses,
    apply_rig,
    choose_recording_rig,
    load_recording,
    load_source,
    parse_sources,
    place_on_rig,
)
from splatnode.recon.result.export import LIVE_PICTURE, read_cameras, remove_result, write_files
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.staged import hold_result_folder, json_bytes
from splatnode.recon.result.message import encode_snapshot, make_depth_header
from splatnode.recon.result.report import bound_result_bytes, print_summary
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.submap_index import FILE, is_map_set

# A viewer beside an offline run: a process of its own that gets the newest snapshot whenever it is ready for one.

Show = Callable[[Snapshot], None]

_SERVE_S = 0.05


@contextlib.contextmanager
def viewer(pictures: Path, command: Sequence[str] | None = None) -> Iterator[Show]:
    """Starts a viewer and gives the function that shows it a snapshot; at the end, waits until it is closed.

    Showing never waits: a snapshot that the viewer has not taken is replaced by the next. Where no window can be
    opened, the viewer keeps a picture in the folder `pictures` up to date and closes itself after the last snapshot.
    `command` begins a viewer; None: the verb view.
    """
    begin = command or python.command("splatnode", "view")
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        config = Path(folder, "node.yaml")
        config.write_text(json.dumps({"network": {"directory": folder}}))  # YAML, whatever the folder's name is
        with _SnapshotServer(Network(directory=Path(folder))) as stage:
            child = subprocess.Popen([*begin, str(config), "--exit-when-final", "--out", str(pictures)])
            try:
                yield stage.show
                child.wait()
            finally:
                child.terminate()
                child.wait()


class _SnapshotServer:
    """Publishes the newest of the snapshots that it is shown, and answers a viewer that comes late, in a thread."""

    def __init__(self, network: Network) -> None:
        self._server = StateServer(RECON_SCENE, network)
        self._depths = StateServer(RECON_DEPTH, network)
        self._newest: Snapshot | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name="audience", daemon=True)

    def __enter__(self) -> _SnapshotServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._thread.join()
        self._server.close()
        self._depths.close()

    def show(self, snapshot: Snapshot) -> None:
        self._newest = snapshot

    def _serve(self) -> None:
        numbering = Numbering()
        depth_numbering = Numbering(numbering.session)
        published = None
        while not self._closing:
            newest = self._newest
            if newest is not None and newest is not published:
                numbers, session = numbering.next(), numbering.session
                self._depths.publish(make_depth_header(newest, session, numbers["sequence"], depth_numbering.next()))
                self._server.publish(*encode_snapshot(newest, session, numbers))
                published = newest
            self._depths.serve(0)
            self._server.serve(_SERVE_S)


# The verbs of the command line that reconstruct.

FEW = 12  # photographs: of so many, the end is near before an estimate is read
# Views, seconds and 10^6 bytes of the largest memory; two cores, preset balanced (tests/bench/results/growth.json).
MEASURED = ((3, 17.5, 481), (6, 23.2, 543), (12, 33.0, 629), (24, 55.9, 775), (48, 103.0, 1212))
_BYTES_A_PIXEL = 3  # of each photograph, which stays in memory as it was read
_SECONDS_RANGE = 0.5, 3.0  # times as long: more cores and a preset that does less, or a slow machine with other work
_MEMORY_RANGE = 0.9, 1.6


def format_cost(sizes: Sequence[tuple[int, int]]) -> str | None:
    """One line about the photographs with these widths and heights; None for so few that nobody needs to know."""
    if len(sizes) <= FEW:
        return None
    views, seconds, megabytes = np.array(MEASURED).T
    count, pixels = len(sizes), sum(width * height for width, height in sizes)
    took_s, took_mb = (
        _interpolate(count, views, seconds),
        _interpolate(count, views, megabytes) + _BYTES_A_PIXEL * pixels / 1e6,
    )
    shortest, longest = (took_s * times for times in _SECONDS_RANGE)
    least, most = (took_mb * times / 1000 for times in _MEMORY_RANGE)
    time = (
        f"{shortest:.0f} to {longest:.0f} s" if longest < 120 else f"{shortest / 60:.1f} to {longest / 60:.0f} minutes"
    )
    memory = f"{least:.1f} to {most:.1f} GB of memory"
    return f"{count} photographs, {pixels / 1e6:.0f} megapixels in all: about {time}, {memory}"


def _interpolate(count: int, views: np.ndarray, measured: np.ndarray) -> float:
    """Between the measured counts; beyond the last one it goes on as between the last two."""
    if count <= views[-1]:
        return float(np.interp(count, views, measured))
    slope = (measured[-1] - measured[-2]) / (views[-1] - views[-2])
    return float(measured[-1] + slope * (count - views[-1]))


EXIT_GOOD, EXIT_REFUSED = 0, 65
LOOK_EVERY = 50  # iterations between the snapshots that a viewer is shown


def replay(args: argparse.Namespace) -> int:
    """Reconstructs a folder of photographs, some photographs of one, a recording, or a video."""
    config = _config(args)
    path, listed, cameras = parse_sources(args.source, args.cameras, config.frame_set_tolerance_s)
    request = Request(path, listed, args.views, args.frames or (), args.every_frame, args.masks, _lenses(args), cameras)
    for source in [path] if cameras is None else [path, *(camera.path for camera in cameras.cameras)]:
        _check_apart(args.out, source)
    if not args.map and is_map_set(args.out):
        raise ValueError(f"{args.out} holds the scenes of a map or of a node ({FILE}); give another --out")
    if args.map and args.multi_view_only:
        raise ValueError("--multi-view-only is for one scene: a merged map does not tell what two photographs confirm")
    if args.map and args.depths is not None:
        raise ValueError("--depths is for one scene; with --map give a folder whose layout has depth (docs/inputs.md)")
    if args.rig is not None:
        read_rig(args.rig)  # before images are read, which takes longer
    if args.map:
        return replay_map(args, request, config)
    with show_progress(quiet=args.json) as tell:
        return _replay(args, request, config, tell)


def _replay(args: argparse.Namespace, request: Request, config: ReconstructionConfig, tell: Tell) -> int:
    given = load_source(request, tell)
    if given.choice is not None:
        tell(str(given.choice))
        if given.choice.left_out.get(THINNED):
            tell("--map uses the keyframes that were thinned out, too, and makes a map of many scenes")
    if not args.json and (taken := format_cost(given.sizes)) is not None:
        say(taken, error=True)
    given, config = apply_rig(given, config, args.rig, tell)
    given = given if args.depths is None else add_depth_folder(given, args.depths)
    check_baseline(config, given)
    trajectory = None if args.poses is None else read_poses(args.poses)
    known = _load_scale_evidence(args, given, trajectory)
    own = {} if trajectory is None else trajectory.find_sigmas(given.frames)
    if known.poses is not None and trusts_poses(args, has_file_sigmas=bool(own)):
        given = add_poses(given, known.poses, args.poses_sigma, own)
        known = replace(known, poses=None)  # they are the photographs' own now
        config = apply_changes(config, {"registration": {"trust_poses": True, **collect_drift_changes(args)}})
    elif args.poses_drift is not None:
        raise ValueError("--poses-drift is of poses that hold the cameras: give --poses FILE and --poses-sigma, too")
    needed_bytes = bound_result_bytes(given.sizes, config.size, config.most_gaussians) + given.further_bytes
    with hold_result_folder(args.out, needed_bytes), _viewer(args) as show:
        config = set_preview_interval(config, LOOK_EVERY) if args.view else config
        preset_name = args.preset or "balanced"
        made = reconstruct_source(
            given, config, preset_name, without_guesses=args.multi_view_only, given=known, show=show, tell=tell
        )
        del given  # and with it photographs that lie in a folder
        tell(ProgressStep("writing the results"))
        snapshot, report = made.snapshot, made.write(args.out)
        if args.json:
            print(json.dumps(report))
        else:
            print_summary(snapshot, args.out)
    return EXIT_GOOD if snapshot.verdict.publishable else EXIT_REFUSED


def _viewer(args: argparse.Namespace) -> contextlib.AbstractContextManager[Show]:
    """A viewer with --view, else nobody. The picture that an earlier run showed is none of this one: it is removed."""
    pictures = args.out / "view"
    (pictures / LIVE_PICTURE).unlink(missing_ok=True)
    return viewer(pictures) if args.view else contextlib.nullcontext(ignore_snapshot)


def _check_apart(out: Path, photographs: Path) -> None:
    """Raises ValueError where the preview would be a photograph of the next run."""
    if out.resolve() == photographs.resolve():
        raise ValueError(f"--out must not be the folder of the photographs; give one in it, such as {out / 'out'}")


def _load_scale_evidence(args: argparse.Namespace, given: Source, trajectory: Trajectory | None) -> Evidence:
    """Loads the scale evidence that the options name. Raises ValueError where it fits none of the images."""
    poses = None if trajectory is None else poses_of(trajectory, given.frames, str(args.poses))
    pairs = () if args.stereo is None else make_pairs(given.frames, stream_right_images(args.stereo, given.frames))
    return Evidence(poses=poses, pairs=pairs)


def _lenses(args: argparse.Namespace) -> Lenses | None:
    """The lenses that are given for photographs."""
    return None if args.intrinsics is None else read_lenses(args.intrinsics)


def _config(args: argparse.Namespace) -> ReconstructionConfig:
    """The preset, then the configuration file, then the flags: what comes later wins."""
    config = preset(args.preset or "balanced")
    if args.config is not None:
        config = apply_changes(config, read_yaml(args.config))
    if args.prior is not None and args.prior != config.prior.kind:
        config = apply_changes(config, {"prior": {"kind": args.prior}})
    config = apply_changes(config, {"metric": collect_metric_changes(args)})
    flags = {
        "size": args.size,
        "device": args.device,
        "seed": args.seed,
        "budget_s": args.budget_s,
        "max_gaussians": args.max_gaussians,
        "max_mb": args.max_mb,
        "frame_set_tolerance_s": args.frame_set_tolerance,
        "no_fallbacks": args.no_fallbacks or None,
        "decision": None
        if args.max_position_error is None
        else {"max_position_error_percent": args.max_position_error},
    }
    return apply_changes(config, {key: value for key, value in flags.items() if value is not None})


# `splatnode replay --map`: all keyframes of a long recording in one map; in several where nothing joins its parts.
#
# It is the node's own work, without a camera, in scenes of some views each. The checkpoint lies in the result folder
# until the map is complete, so an interrupted run goes on where it was.

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
            for together in _receive_sets(frames, identity, node.frame_set_tolerance_s):
                new = [each for each in together if each.sequence >= taken]
                if new:
                    _enqueue_frames(new, node.reconstruction, store, inbox, stopping, check)
                    taken = new[-1].sequence + 1
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


def _receive_sets(
    frames: Iterable[Frame | DroppedFrame], identity: str, tolerance_s: float
) -> Iterator[list[ReceivedFrame]]:
    """The frames with their numbers, those that several cameras took together as one."""
    numbers = itertools.count()
    for each in group_frame_sets(frames, tolerance_s):
        together = each if isinstance(each, tuple) else (each,)
        yield [ReceivedFrame(identity, next(numbers), frame) for frame in together]


def _enqueue_frames(
    together: Sequence[ReceivedFrame], config: ReconstructionConfig, store: Store, inbox: Inbox,
    stopping: threading.Event, check: Callable[[], None],
) -> None:  # fmt: skip
    """Waits while the worker has enough to do. A frame that cannot be used is recorded with the reason."""
    stored = store.add_frames(together)
    events: list[Event] = []
    for each in stored:
        name = each.frame.name
        try:
            keyframe = prepare(each.frame, config)
        except Exception as error:
            if is_shortage(error):
                raise
            log.warning("%s cannot be used: %s", name, error)
            store.forget(name, f"cannot be used: {error}")
            events.insert(0, RemovedFrame(name))  # first: nothing is between the others
        else:
            events.append(ArrivedKeyframe(keyframe, time.monotonic(), stored[0].number if len(stored) > 1 else None))
    if events:
        inbox.enqueue(events, stopping, check)


_OF_ONE_SCENE = ("views", "frames", "view", "budget_s", "baseline", "marker", "poses", "stereo", "gravity")


def replay_map(args: argparse.Namespace, request: Request, config: ReconstructionConfig) -> int:
    """Writes the scenes, their places.json, a merged result for each map, and a report.json about all."""
    given = [f"--{name.replace('_', '-')}" for name in _OF_ONE_SCENE if getattr(args, name)]
    if given:
        raise ValueError(f"--map makes many scenes and does not go with what is about one: {', '.join(given)}")
    check_incomplete(args.out)
    with show_progress(quiet=args.json) as tell:
        source = load_recording(request, tell)
        tell(str(source.choice))
        rig, config = choose_recording_rig(source, config, args.rig, tell)
        _check_frame(config, source, rig)
    began_s = time.monotonic()
    with hold_result_folder(args.out, KEYFRAME_BYTES * len(source.choice.names)):
        remove_result(args.out)  # of one scene, beside which nobody would find the map's
        frames = _write_frames(source, args.out) if source.photographs is None else source.frames()
        if rig is not None:
            frames = map(partial(place_on_rig, rig=rig), frames)
        printer = _ProgressPrinter(args.json, len(source.choice.names))
        with _limit_log_level():
            make_scenes(frames, source.identity(config, rig), make_node_config(config, args.out), printer)
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


def _check_frame(config: ReconstructionConfig, source: ReplayRecording, rig: Rig | None) -> None:
    """Raises UnknownFrame where neither the recording nor the rig can tell the frame of reference."""
    on_base = rig.cameras if rig is not None and rig.is_base else ()
    mounts = {each.camera_id: each.matrix for each in on_base if each.matrix is not None}
    has_lengths = source.has_depth or config.registration.rig is not None or len(source.evidence.mounts) > 1
    check_frame(config.metric, source.evidence.merge(Evidence(mounts=mounts)), has_lengths)


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
