"""`splatnode recon CONFIG`: the process. The main thread has the sockets below; other threads do the work.

intake    capture.keyframes -> checkpoint, acknowledged -> inbox
worker    inbox -> scenes, saved and exported
watcher   capture.preview -> has the camera moved?
locator   recon.locate: where clients took their images, in what is shown
main      recon.scene, recon.depth, recon.map, recon.status, recon.control; the service manager; signals

It says that a disk is nearly full while it can still write: before a keyframe or a result is refused."""

from __future__ import annotations

import argparse
import contextlib
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence

import msgspec

from splatnode.capture.messaging.messages import Name, Numbering
from splatnode.capture.messaging.network import (
    RECON_CONTROL,
    RECON_DEPTH,
    RECON_MAP,
    RECON_SCENE,
    RECON_STATUS,
    AlreadyRunning,
    files_for_strangers,
)
from splatnode.capture.messaging.pubsub import (
    Answer,
    CommandServer,
    MarkProblemsSeen,
    NoAnswer,
    Publisher,
    StateServer,
    ask,
)
from splatnode.capture.process.config import load_config
from splatnode.capture.process.files import shortage, state_directory
from splatnode.capture.process.system import (
    ServiceManager,
    handle_first_signal,
    is_shortage,
    make_sure_of_room,
    raise_file_limit,
    raise_shortage,
    resident_mb,
    wrap_late_errors,
)
from splatnode.capture.process.terminal import (
    Problems,
    Unfailing,
    event,
    is_logged,
    say,
    show_progress,
    use_structured_lines,
)
from splatnode.capture.process.text import sanitize_text
from splatnode.recon.config import apply_changes
from splatnode.recon.daemon import ReconState, ReconStatus, WorldRecord, WorldRevisions
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.free_space import (
    NOT_FINAL,
    GrowingMapper,
    GrowingScene,
    OccupancyResult,
    ProvisionalMap,
    WholeMapper,
)
from splatnode.recon.daemon.ingest import Inbox, Intake, RemovedFrame
from splatnode.recon.daemon.output import OccupancyPublisher, PublishedSnapshot
from splatnode.recon.daemon.relocalization import LocatableScene, Locator, Watcher
from splatnode.recon.daemon.worker import Worker
from splatnode.recon.metric.arguments import collect_frame_changes, collect_marker_changes
from splatnode.recon.result import snapshot as result_snapshot
from splatnode.recon.result.export.staged import finish_interrupted_write, hold_result_folder
from splatnode.recon.result.message import CameraRecord, encode_snapshot, make_camera_record, make_depth_header
from splatnode.recon.result.report import estimate_result_bytes
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.submap_index import is_map_set

log = logging.getLogger(__name__)

# In the checkpoint. Keyframe of 1280 x 720: photograph 2.8 MB, point map 1.2 MB, features and pairs 1 to 2 MB.
BYTES_A_KEYFRAME = 6_000_000
BYTES_A_GAUSSIAN = 56  # 14 numbers of 4 bytes


class DiskSpace:
    """The free space where the daemon writes, against what it may still write."""

    def __init__(self, config: DaemonConfig, store: Store) -> None:
        self._config, self._store = config, store
        self._problem = ""

    def describe_problem(self) -> str:
        """Describes what may not fit and where; empty where there is room for all. A change is logged."""
        further_keyframes = max(0, self._config.max_views - len(self._store.names))
        most_gaussians = self._config.max_gaussians
        checkpoint_bytes = further_keyframes * BYTES_A_KEYFRAME + most_gaussians * BYTES_A_GAUSSIAN
        try:
            problem = shortage(self._store.directory, checkpoint_bytes, "the checkpoint") or shortage(
                self._config.out, estimate_result_bytes(most_gaussians, self._config.max_views), "the result"
            )
        except OSError as error:
            if is_shortage(error):  # this time it is not known
                return self._problem and f"{self._problem}: make room on the disk"
            problem = f"the disk does not tell how much is free ({error.strerror or error})"
        if bool(problem) != bool(self._problem):
            event(log, logging.WARNING if problem else logging.INFO, "disk_space", problem=problem or "none")
        self._problem = problem
        return problem and f"{problem}: make room on the disk"


# Commands to the running daemon, and the verb `remove-keyframe` that sends one.

EXIT_GOOD, EXIT_UNKNOWN_NAME, EXIT_NO_SCENE, EXIT_UNFINISHED = 0, 2, 65, 75


class RemoveKeyframe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="retract"):
    """Remove the keyframe with this name."""

    name: Name


class Finish(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="finish"):
    """Finalize all scenes, merge those of each map, and end. The answer says what is left to be done."""


Command = RemoveKeyframe | MarkProblemsSeen | Finish


def remove_keyframe(args: argparse.Namespace) -> int:
    """Asks the daemon to remove a keyframe; returns 2 where there is none of that name."""
    config = load_config(args.config, DaemonConfig) if args.config else DaemonConfig()
    answer = ask(RECON_CONTROL, config.network, RemoveKeyframe(args.name), Answer)
    say(answer.message)
    return EXIT_GOOD if answer.done else EXIT_UNKNOWN_NAME


SERVE_S = 0.05  # between looks at what the threads have produced
_SOCKETS = 9  # that it binds: of states two
_FILES, _THREADS = 144, 32  # of which the daemon has need: seven endpoints, its own threads, those that compute
END_S = 20.0  # for the threads to end; an export takes seconds
QUIET_S = 2.0  # in which no keyframe comes before a node that finishes ends: capture sends what it still keeps
RESTS = 2  # looks at which nothing was left to be done, likewise
ASK_AGAIN_S = 1.0  # how far a running node is
STUCK_S = (
    300.0  # without progress the worker counts as stuck; its longest step, verifying all views, takes tens of seconds
)


def recon(args: argparse.Namespace) -> int:
    """Runs until SIGTERM or SIGINT and returns 0. A second signal ends the process at once."""
    use_structured_lines()
    config = load_config(args.config, DaemonConfig) if args.config else DaemonConfig()
    if args.checkpoint:
        config = msgspec.structs.replace(config, checkpoint=args.checkpoint)
    if args.out:
        config = msgspec.structs.replace(config, out=args.out)
    if changes := collect_marker_changes(args) | collect_frame_changes(args):
        recipe = apply_changes(config.reconstruction, {"metric": changes})
        config = msgspec.structs.replace(config, reconstruction=recipe)
    stopping = threading.Event()
    handle_first_signal((signal.SIGTERM, signal.SIGINT), stopping.set)
    try:
        with Daemon(config, stopping, args.finish) as daemon:
            daemon.run()
    except AlreadyRunning:
        if not args.finish:
            raise
        if given := _list_own_flags(args):
            raise ValueError(
                f"{', '.join(given)}: a node runs already, with its own settings. Give --finish alone, or stop it"
            ) from None
        return _wait_for_running_node(config, stopping)
    if daemon.left:
        say(f"not finished: {daemon.left}", error=True)
        return EXIT_UNFINISHED
    if daemon.finished and not is_map_set(config.out):
        checkpoint = config.checkpoint or state_directory() / "recon"
        say(
            f"no scene lies in {config.out}: {checkpoint} has no keyframes, or its scenes were written elsewhere. To "
            "make them anew, replay the recording",
            error=True,
        )
        return EXIT_NO_SCENE
    return 0


def _list_own_flags(args: argparse.Namespace) -> list[str]:
    """The flags that say how a node of its own would work."""
    return [f"--{name}" for name in ("checkpoint", "out", "marker", "frame", "gravity") if getattr(args, name)]


def _wait_for_running_node(config: DaemonConfig, stopping: threading.Event) -> int:
    """Has the node that runs finish, and waits until it has ended. Raises NotAllowed, WireError."""
    answer = ask(RECON_CONTROL, config.network, Finish(), Answer)
    with show_progress() as tell:
        while not stopping.wait(ASK_AGAIN_S):
            tell(answer.message)
            try:
                answer = ask(RECON_CONTROL, config.network, Finish(), Answer)
            except NoAnswer:  # it has ended
                break
    if answer.done and not stopping.is_set():
        return 0
    say(answer.message, error=True)
    return EXIT_UNFINISHED


class Daemon:
    def __init__(self, config: DaemonConfig, stopping: threading.Event, finish: bool = False) -> None:
        """If `finish`, the daemon ends by itself once every keyframe is in a final scene and the maps are merged.

        Raises AlreadyRunning, CheckpointError, FolderInUse, LimitTooLow, NetworkError, OSError."""
        self._config, self._stopping = config, stopping
        self._resources = contextlib.ExitStack()
        self._problems = Problems()
        self._worlds = WorldRevisions()
        with self._close_on_error():
            raise_file_limit()
            network = config.network
            make_sure_of_room(_FILES + files_for_strangers(network, _SOCKETS), _THREADS)
            self._scenes = self._resources.enter_context(StateServer(RECON_SCENE, network))
            self._depths = self._resources.enter_context(StateServer(RECON_DEPTH, network))
            maps = self._resources.enter_context(StateServer(RECON_MAP, network)) if config.occupancy.live else None
            self._heartbeat = self._resources.enter_context(Publisher(RECON_STATUS, network))
            self._commands = self._resources.enter_context(CommandServer(RECON_CONTROL, network, Command))
            self._locator = None
            if config.localization.live:
                self._locator = Locator(network, self._problems, stopping)
                self._resources.callback(self._locator.close)
            self._store = Store(config.checkpoint or state_directory() / "recon")
            self._resources.callback(self._store.close)
            self._resources.enter_context(hold_result_folder(config.out))
            for folder in config.out.glob("scene-*"):
                finish_interrupted_write(folder, [folder / "colmap"])
        self._disk_space = DiskSpace(config, self._store)
        self._inbox = Inbox()
        self._newest = _NewestSnapshot()
        together = msgspec.structs.replace(config.frame_sets, tolerance_s=config.frame_set_tolerance_s)
        several = together, config.further_captures
        self._intake = Intake(
            network, config.reconstruction, self._store, self._inbox, self._problems, stopping, *several
        )
        self._worker = Worker(config, self._store, self._inbox, self._newest.update, stopping, self._worlds)
        self._watcher = Watcher(
            network, config.tracking, lambda: self._worker.active.finished, self._problems, stopping
        )
        self._scene_numbers = Numbering()
        session = self._scene_numbers.session
        self._depth_numbers = Numbering(session)
        self._status_numbers = Numbering(session)
        self._maps = None if maps is None else OccupancyPublisher(maps, Numbering(session))
        mapped = config.occupancy.live and config.occupancy.provisional
        self._growing = GrowingMapper(config.occupancy.voxel, self._problems, stopping) if mapped else None
        helper = config.out, config.occupancy.voxel, self._problems, stopping
        grows = self._find_growing_map if mapped else None
        self._whole = WholeMapper(*helper, grows) if config.occupancy.maps else None
        self._world: WorldRecord | None = None  # of what is shown
        self._sequence = 0  # of the last scene's message
        self._started_s = time.monotonic()
        self._shown: PublishedSnapshot | None = None
        self._errors: list[BaseException] = []
        self._finish = _Finish() if finish else None
        self._merged: threading.Thread | None = None  # once all is final
        self._merged_s = -math.inf  # monotonic: when it was last seen at work
        self.finished = False  # as it was asked to, and not stopped
        self.left = ""  # what a node that finishes could not do
        self._heart = Unfailing("the heartbeat")
        self._service_status = ReconState.LOADING.value  # as the service manager shows it

    def __enter__(self) -> Daemon:
        return self

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    def run(self) -> None:
        """Runs until the daemon is stopped. Raises what ended one of its threads."""
        manager = ServiceManager()
        with wrap_late_errors(manager):
            self._run(manager)

    def _run(self, manager: ServiceManager) -> None:
        beside = [each for each in (self._locator, self._growing, self._whole) if each is not None]
        threads = [self._start_thread(each.run) for each in (self._intake, self._worker, self._watcher, *beside)]
        manager.ready()
        event(log, logging.INFO, "ready", checkpoint=self._store.directory, out=self._config.out)
        next_status_s = 0.0
        try:
            while not self._stopping.is_set():
                self._scenes.serve(SERVE_S)
                self._depths.serve(0)
                self._commands.serve(0, self._answer)
                if self._maps is not None:
                    self._maps.serve()
                self._publish()
                self._publish_map(self._worker.current_map)
                self._end_if_finished()
                if time.monotonic() >= next_status_s:
                    next_status_s = time.monotonic() + self._config.status_interval_s
                    self._heart.do(self._beat)
                    if time.monotonic() - self._worker.moved_s < STUCK_S:  # else the service manager restarts it
                        manager.alive(self._service_status)
        finally:
            self._stopping.set()
            manager.stopping()
            self._join_threads(threads)
        if self._errors:
            raise self._errors[0]
        event(log, logging.INFO, "stopped")

    def _end_if_finished(self) -> None:
        """Merges the final scenes of a node that finishes, then stops it."""
        if self._finish is None:
            return
        if self._merged is not None:
            if self._merged.is_alive():
                self._merged_s = time.monotonic()
            elif time.monotonic() - self._merged_s >= QUIET_S:  # whoever asked hears what came of it
                self.finished = True
                self._stopping.set()
            return
        waiting = self._worker.count_waiting()
        if self._finish.is_over(waiting, self._intake.newest, self._worker.rests):
            self.left = self._describe_left()
            self._merged, self._merged_s = self._start_thread(self._merge_maps), time.monotonic()

    def _describe_left(self) -> str:
        """Describes the work that is left; empty where all is final."""
        waiting, places = self._worker.count_waiting(), self._worker.num_unfinished
        left = [f"keyframes that no scene shows yet: {waiting}"] if waiting else []
        left += [f"places that are not final yet: {places}"] if places else []
        return sanitize_text("; ".join([*left, *filter(None, [self._worker.problem])]))

    def _merge_maps(self) -> None:
        """Merges the scenes of each map that has several. What cannot be merged is a problem, and no reason to fail."""
        from splatnode.recon.merging import write_maps  # brings what merges

        if not is_map_set(self._config.out):  # no scene was made
            return
        try:
            reports = write_maps(self._config.out, self._config.out, lambda _: None, quiet=True, least=2)
            event(log, logging.INFO, "merged", maps=", ".join(reports) or "none")
        except (OSError, ValueError) as error:
            raise_shortage(error)
            self.left = sanitize_text(f"the maps are not merged: {error}. Run: splatnode merge {self._config.out}")

    def _beat(self) -> None:
        status = self._make_status()
        self._service_status = f"{status.state.value}, {status.keyframes} keyframes, {status.verdict}"
        self._heartbeat.send(status)

    def _start_thread(self, run: Callable[[], None]) -> threading.Thread:
        def run_and_record_error() -> None:
            try:
                run()
            except BaseException as error:
                self._errors.append(error)
                self._stopping.set()

        thread = threading.Thread(target=run_and_record_error, name=type(run).__name__, daemon=True)
        thread.start()
        return thread

    def _join_threads(self, threads: list[threading.Thread]) -> None:
        """Waits until the threads have written what they are writing: an export, a keyframe."""
        deadline = time.monotonic() + END_S
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        if any(thread.is_alive() for thread in threads):
            log.error("a thread did not end within %d s; the file that it was writing is not there", END_S)

    def _publish(self) -> None:
        shown = self._newest.take()
        if shown is None:
            return
        self._shown = shown
        self._world = self._worlds.update(shown.scene_id, shown.snapshot)
        self._publish_map(NOT_FINAL)  # first: no map of another world is there when this scene comes
        numbers = self._scene_numbers.next()
        self._sequence = int(numbers["sequence"])
        self._show_to_helpers(shown, self._world)
        try:
            header, arrays = encode_snapshot(shown.snapshot, shown.scene_id, numbers)
            depth = self._depth_numbers.next()
            self._depths.publish(make_depth_header(shown.snapshot, shown.scene_id, self._sequence, depth))
            self._scenes.publish(header, arrays)
        except Exception as error:  # of one snapshot; the next one may do
            if is_logged(self._problems.add("scenes that could not be shown", f"{type(error).__name__}: {error}")):
                log.exception("a scene could not be shown")

    def _publish_map(self, found: OccupancyResult | str) -> None:
        if self._maps is not None:
            self._maps.publish(found, self._shown, self._sequence, self._find_growing_map())

    def _find_growing_map(self) -> ProvisionalMap | None:
        """The provisional map, if it is in the world of what is shown."""
        made, world = None if self._growing is None else self._growing.made, self._world
        if made is None or world is None or self._shown is None or self._shown.snapshot.final:
            return None
        return made if (made.of.scene_id, made.of.revision) == (world.scene_id, world.revision) else None

    def _show_to_helpers(self, shown: PublishedSnapshot, world: WorldRecord) -> None:
        """Gives the scene to the threads that locate images in it, and that map it while it grows."""
        if self._locator is not None:
            told = self._scene_numbers.session, self._sequence, world.revision, world.provisional
            self._locator.show(LocatableScene(shown.snapshot, shown.scene_id, *told, shown.estimate))
        if self._growing is not None and shown.pointmaps is not None and shown.snapshot.verdict.publishable:
            told = self._sequence, world.revision, shown.pointmaps, shown.shown_s
            self._growing.show(GrowingScene(shown.snapshot, shown.scene_id, *told))

    def _answer(self, command: Command) -> Answer:
        if isinstance(command, MarkProblemsSeen):
            self._problems.mark_seen()
            return Answer(True, "the problems are not told again")
        if isinstance(command, Finish):
            self._finish = self._finish or _Finish()
            if self.left:
                return Answer(False, f"not finished: {self.left}")
            doing = "merging" if self._merged is not None else self._describe_left() or "making the last scene final"
            return Answer(True, f"finishing; {doing}")
        return self._retract(self._worker.find_frame_set(command.name))

    def _retract(self, names: Sequence[str]) -> Answer:
        """Takes out a keyframe, the first, with all that other cameras took at the same time: all at once."""
        left = [(scene, each) for each in names for scene in self._worker.find_inactive_scenes(each)]
        there = self._store.names
        here, (name, *others) = [each for each in names if each in there], names
        if not left and not here:
            known = ", ".join(sorted(there)) or "none yet"
            return Answer(False, sanitize_text(f"no keyframe {name!r}; there are: {known}"))
        try:
            self._store.forget_frames(here, "retracted", left)
        except OSError as error:
            return Answer(False, sanitize_text(f"{name} cannot be removed ({error.strerror}): make room on the disk"))
        self._inbox.enqueue_now(*map(RemovedFrame, here))
        scenes = ", ".join(dict.fromkeys(scene for scene, _ in left))
        event(log, logging.INFO, "retracted", frame=",".join(names), left=scenes)
        those = f"{scenes}, which the camera has left, is built anew without it when no keyframe waits"
        told = [*(["the scene is built anew without it"] if here else []), *([those] if left else [])]
        together = f"; with it {', '.join(others)}, taken at the same time" if others else ""
        return Answer(True, sanitize_text(f"{name} is removed; {'; '.join(told)}{together}"))

    def _make_status(self) -> ReconStatus:
        snapshot = self._shown.snapshot if self._shown else None
        intake, worker, motion, tracked = self._intake, self._worker, self._watcher.motion, self._watcher.tracked
        delay_s, delay = worker.delay
        scenes, maps, loops = worker.map_counts
        return ReconStatus(
            **self._status_numbers.next(),
            state=ReconState.FULL if intake.full else ReconState.LOADING if worker.loading else worker.active.state,
            uptime_s=time.monotonic() - self._started_s,
            scene_id=self._store.scene_id,
            keyframe=intake.newest,
            queue=len(self._inbox),
            keyframes=len(snapshot.cameras) if snapshot else 0,
            num_gaussians=len(snapshot.gaussians) if snapshot else 0,
            iterations=snapshot.iterations if snapshot else 0,
            final=bool(snapshot and snapshot.final),
            verdict=snapshot.verdict.code.value if snapshot else "",
            message=sanitize_text(snapshot.verdict.message) if snapshot else "",
            bounds=sanitize_text(result_snapshot.format_widest_bounds(snapshot.cameras, snapshot.scale))
            if snapshot
            else "",
            keyframe_s=worker.active.keyframe_s,
            delay_s=delay_s,
            delay=delay,
            unfinished=worker.num_unfinished,
            scenes=scenes,
            maps=maps,
            loops=loops,
            newest_places=worker.newest_submaps,
            refused=intake.refused + self._commands.refused + self._scenes.refused,
            duplicates=intake.duplicates,
            rss_mb=resident_mb(),
            camera_moved=motion.moved if motion else None,
            moved=str(motion) if motion and motion.moved else "",
            tracked=_make_live_camera_record(tracked),
            worlds=self._worlds.records,
            work=worker.work,
            problem=self._describe_problem(),
        )

    def _describe_problem(self) -> str:
        """Describes what keeps the node from working now, and problems that nobody has acknowledged yet."""
        for what, endpoint in (("commands", self._commands), ("requests for scenes", self._scenes)):
            self._problems.count(f"{what} that were refused", endpoint.refused, endpoint.why_refused)
        intake = self._intake
        now = intake.full or intake.unconnected or self._worker.problem or self._disk_space.describe_problem()
        return sanitize_text("; ".join(filter(None, (now, str(self._problems)))))

    @contextlib.contextmanager
    def _close_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._resources.close()
            raise


class _Finish:
    """Tells when all that a node was given is worked in: no keyframe comes any more, and nothing is left to be done."""

    def __init__(self) -> None:
        self._newest: int | None = None  # keyframe
        self._rests: int | None = None  # of the worker, when the newest one came
        self._since_s = time.monotonic()

    def is_over(self, waiting: int, newest: int, rests: int) -> bool:
        if waiting or newest != self._newest or self._rests is None:
            self._newest, self._rests, self._since_s = newest, rests, time.monotonic()
            return False
        return rests - self._rests >= RESTS and time.monotonic() - self._since_s >= QUIET_S


def _make_live_camera_record(tracked: CameraEstimate | None) -> CameraRecord | None:
    """None, too, for one that nothing can be seen through: tracking went astray."""
    try:
        return None if tracked is None else make_camera_record(tracked)
    except ValueError as error:
        log.debug("where the live camera is cannot be told: %s", error)
        return None


class _NewestSnapshot:
    """Holds the newest snapshot that has not been published, between two threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shown: PublishedSnapshot | None = None

    def update(self, shown: PublishedSnapshot) -> None:
        with self._lock:
            self._shown = shown

    def take(self) -> PublishedSnapshot | None:
        with self._lock:
            shown, self._shown = self._shown, None
            return shown
