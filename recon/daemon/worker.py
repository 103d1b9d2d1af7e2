"""The thread that reconstructs: works keyframes in as they come, and makes scenes as good as they get in between.

The scenes of inactive submaps are made final in between.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from splatnode.capture.process.files import is_disk_error
from splatnode.capture.process.system import SHORT_OF_MEMORY, is_shortage, raise_shortage
from splatnode.capture.process.terminal import event
from splatnode.capture.rig import form_frame_sets
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon import (
    PLACES,
    Backlog,
    SubmapStatus,
    Work,
    WorkMeter,
    WorkProgress,
    WorldRevisions,
    checkpoint,
    ledger,
    submap,
)
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.free_space import OccupancyMapper, OccupancyResult
from splatnode.recon.daemon.ingest import BATCH, ArrivedKeyframe, Event, Inbox, RemovedFrame, are_one_set
from splatnode.recon.daemon.ledger import CheckpointError
from splatnode.recon.daemon.loop_closure import LoopDetector
from splatnode.recon.daemon.output import Output, PublishedSnapshot
from splatnode.recon.daemon.pose_graph import EdgeKind
from splatnode.recon.daemon.submap import Abandoned, ActiveSubmap
from splatnode.recon.daemon.submap_index import SubmapState
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.modelling import SceneWithVerdict
from splatnode.recon.threads import RunContext

# The thread that reconstructs: works keyframes in as they come, and makes scenes as good as they get in between.

log = logging.getLogger(__name__)

IDLE_S = 0.5  # between looks at whether to stop
FIRST_WAIT_S, LONGEST_WAIT_S = 5.0, 300.0  # after a step for which memory or disk did not suffice; doubled each time
FALLBACK_TIMEOUT_S = 4.0  # in which more matches may be looked for, also on a slow machine: keyframes wait meanwhile


class Worker:
    def __init__(
        self,
        config: DaemonConfig,
        store: Store,
        inbox: Inbox,
        publish: Callable[[PublishedSnapshot], None],
        stopping: threading.Event,
        worlds: WorldRevisions | None = None,
    ) -> None:
        """`worlds` hears which scenes are made afresh."""
        limit = min(config.max_gaussians, config.reconstruction.max_gaussians or config.max_gaussians)
        fallbacks = config.reconstruction.fallbacks
        if fallbacks.timeout_s is None:
            fallbacks = msgspec.structs.replace(fallbacks, timeout_s=FALLBACK_TIMEOUT_S)
        self._recipe = msgspec.structs.replace(
            config.reconstruction,
            max_gaussians=limit,
            budget_s=None,
            fallbacks=fallbacks,
            frame_set_tolerance_s=config.frame_set_tolerance_s,
        )
        self._config, self._store, self._inbox, self._stopping = config, store, inbox, stopping
        self._output = Output(config, store, publish, self._report_problem, worlds)
        self._meter = WorkMeter()
        self.active = ActiveSubmap(config, self._recipe, store, self._output, self._pause, self._meter)
        self._free_space = OccupancyMapper(config.occupancy)
        self._loop_detector = LoopDetector(store.directory, self._recipe, self._output.index)
        self._inactive = InactiveSubmaps(
            store, self._recipe, self._output, self._loop_detector, config.fallback_timeout_s, self._meter
        )
        self._quiet_since_s = time.monotonic()  # when what came last was worked in
        self._wait_s, self._not_before_s = FIRST_WAIT_S, -math.inf  # for memory or the disk; monotonic
        self._shortage = ""  # the last one that was told
        self.problem = ""
        self.moved_s = time.monotonic()  # when the work last got on
        self.rests = 0  # how often there was nothing to do
        self._backlog: list[ArrivedKeyframe] = []  # keyframes that an earlier process stored and did not work in
        self.loading = len(store.names)  # keyframes of an earlier process that are not known again yet

    @property
    def num_unfinished(self) -> int:
        """Counts the inactive submaps whose scenes are not final yet."""
        return self._inactive.num_unfinished

    def count_waiting(self) -> int:
        """Keyframes that no scene shows yet."""
        return self.loading + len(self._backlog) + len(self.active.under_way) + len(self._inbox)

    @property
    def map_counts(self) -> tuple[int, int, int]:
        """How many scenes are judged, how many maps they are, and how many loops count."""
        poses, links = self._output.index.poses, self._output.index.links
        loops = sum(link.kind is EdgeKind.LOOP and link.retracted is None for link in links)
        return len(poses), len({pose.map for pose in poses}), loops

    @property
    def newest_submaps(self) -> tuple[SubmapStatus, ...]:
        """The status of the newest submaps, each as of when it was last worked on; the active one as it is shown."""
        records = {each.scene_id: each for each in self._output.index.select_newest(PLACES)}
        if (active := self.active.record) is not None:
            records[active.scene_id] = active
        return tuple(each.status for each in records.values())[-PLACES:]

    @property
    def current_map(self) -> OccupancyResult | str:
        """The map of the present scene as it is now, or why there is none."""
        return self._free_space.find_current_map(self.active.finished, self.active.state)

    @property
    def work(self) -> WorkProgress | None:
        """Tells what is being done, and how long the rest of it takes; None while nothing is."""
        return self._meter.describe(Backlog(self.count_waiting(), self._inactive.num_unjudged, self.num_unfinished))

    def find_inactive_scenes(self, name: str) -> list[str]:
        """The ids of the scenes of inactive submaps that have a camera of this photograph."""
        return [scene for scene in self._output.index.find_scenes(name) if scene != self._store.scene_id]

    def find_frame_set(self, name: str) -> list[str]:
        """The photograph, and those that other cameras took with it, here and in inactive submaps."""
        tolerance_s, index = self._recipe.frame_set_tolerance_s, self._output.index
        found = [self._store.find_frame_set(name, tolerance_s)]
        found += [index.find_frame_set(scene, name, tolerance_s) for scene in self.find_inactive_scenes(name)]
        return list(dict.fromkeys([name, *itertools.chain.from_iterable(found)]))

    @property
    def delay(self) -> tuple[float, str]:
        """How long the oldest keyframe has waited that no scene shows yet, seconds, and what it waits for."""
        if self.loading:
            return time.monotonic() - self._quiet_since_s, f"{_format_keyframe_count(self.loading)} being loaded"
        under_way, waiting = [*self.active.under_way, *self._backlog], len(self._inbox)
        oldest_s = under_way[0].at_s if under_way else self._inbox.oldest_s
        if oldest_s is None:
            return 0.0, ""
        return (
            time.monotonic() - oldest_s,
            f"{_format_keyframe_count(len(under_way))} being worked in, {waiting} more waiting",
        )

    def run(self) -> None:
        """Until the daemon stops; an export that has begun is finished. Raises MemoryError and the like."""
        found = self._restore()
        self.loading = 0
        if found is not None:
            self._backlog = number_frame_sets(found.new, self._config.frame_set_tolerance_s)
            self._run_step(lambda: self.active.resume(found))
        give_back_memory()
        while not self._stopping.is_set():
            worked = self._process_events(min(IDLE_S, self._config.idle_finalize_s))
            if not worked and self.active.settled and time.monotonic() >= self._not_before_s:
                self._run_step(self._process_idle, present=False)
        self._run_step(self.active.export_provisionally)

    def _process_idle(self) -> None:
        """Does one step of work that is left while the active submap needs nothing."""
        self._meter.restart_count(Work.KEYFRAMES)
        if self.active.retry_write():
            self.problem = ""
            return
        if not (
            self._map_scene()
            or self._inactive.verify_next(RunContext(self._serve_active_submap))
            or self.active.detect_loops(self._loop_detector)
            or self._inactive.finalize_next(RunContext(self._serve_active_submap))
        ):
            self.rests += 1

    def _map_scene(self) -> bool:
        """Maps the present scene, if it is final; False where that was done. Abandoned when something comes."""
        folder = self._config.out / self._store.scene_id
        run = RunContext(lambda: self._pause(-math.inf))
        return self._free_space.map_scene(self.active.finished, self.active.state, folder, run)

    def _process_events(self, wait_s: float) -> bool:
        """Works in what has come, or makes the scene better if it is time; False where there was nothing to do."""
        self.moved_s = time.monotonic()
        events = self._take_events(wait_s)
        arrived = [each for each in events if isinstance(each, ArrivedKeyframe)]
        left_out = [each.name for each in events if isinstance(each, RemovedFrame)]
        now = time.monotonic()
        if arrived:
            self._run_step(lambda: self._add_keyframes(arrived))
        elif left_out:
            self._run_step(lambda: self.active.remove_frames(left_out))
        elif (
            self.active.settled or now < self._not_before_s or now - self._quiet_since_s < self._config.idle_finalize_s
        ):
            return False
        else:
            self._run_step(lambda: self._add_keyframes([]) if self.active.owed else self.active.finalize())
        self._quiet_since_s = time.monotonic()
        return True

    def _take_events(self, wait_s: float) -> Sequence[Event]:
        """Returns the events to process next: first what an earlier process stored, a batch at a time."""
        if self._backlog:
            count = min(BATCH, len(self._backlog))
            while count < len(self._backlog) and are_one_set(self._backlog[count - 1], self._backlog[count]):
                count += 1
            events, self._backlog = self._backlog[:count], self._backlog[count:]
            return events
        return self._inbox.dequeue(wait_s)

    def _add_keyframes(self, arrived: list[ArrivedKeyframe]) -> None:
        """A keyframe that was retracted while it was prepared comes after the word of that, and is not taken in."""
        self.problem = ""
        stored = [each for each in arrived if self._store.holds(each.keyframe.frame)]
        if stored or not arrived:
            with self._meter.measure(Work.KEYFRAMES, len(stored), len(stored)):
                self.active.add_keyframes(stored)

    def _serve_active_submap(self) -> None:
        """While the scene of an inactive submap is finished, the present one goes on.

        Raises Abandoned if the daemon stops.
        """
        self._pause(math.inf)
        began = time.monotonic()
        self._process_events(0.0)
        if self.active.settled:
            self._run_step(self._map_scene, present=False)
        self._inactive.exclude_seconds(time.monotonic() - began)

    def _pause(self, until_s: float) -> None:
        """Raises Abandoned if the daemon stops, and from `until_s` (monotonic) on if something has come."""
        self.moved_s = time.monotonic()
        waiting = len(self._inbox) + len(self._backlog)
        if self._stopping.is_set() or (waiting and self.moved_s > until_s):
            raise Abandoned

    def _run_step(self, step: Callable[[], object], present: bool = True) -> None:
        """A step that fails is told, and repeated only where memory or the disk did not suffice.

        `present`: whether it is for the active submap.
        """
        try:
            step()
            if self._wait_s > FIRST_WAIT_S:
                self._wait_s = FIRST_WAIT_S
                if self.problem == self._shortage:
                    self.problem = ""
        except Abandoned:
            pass
        except Exception as error:
            log.exception("a step of the reconstruction failed")
            short = is_shortage(error)
            again = short or is_disk_error(error)
            self.problem = f"{type(error).__name__}: {error}"
            if present:
                self.active.settled = not again
            if again:
                why = SHORT_OF_MEMORY if short else f"{error}: make room on the disk"
                self.problem = self._shortage = f"{why}. What failed is tried again"
                self._not_before_s = time.monotonic() + self._wait_s
                self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)

    def _restore(self) -> checkpoint.RestoredReconstruction | None:
        """Restores what an earlier process knew. Raises MemoryError: a restart may have more memory."""
        try:
            return checkpoint.restore(self._store, self._recipe)
        except Exception as error:
            if is_shortage(error):
                raise
            log.exception("the checkpoint cannot be restored")
            self.problem = f"the checkpoint cannot be restored: {error}"
            return None

    def _report_problem(self, problem: str) -> None:
        self.problem = problem
        log.error("%s", problem)


def number_frame_sets(keyframes: Sequence[Keyframe], tolerance_s: float) -> list[ArrivedKeyframe]:
    """Keyframes that an earlier process stored, each with the number of its frame set, those of one side by side."""
    frames = [each.frame for each in keyframes]
    timed = [(each.name, each.camera_id, each.captured_at) for each in frames if each.captured_at is not None]
    sets = {name: number for number, each in enumerate(form_frame_sets(timed, tolerance_s)) if len(each.names) > 1
            for name in each.names.values()}  # fmt: skip
    first = {number: index for index, each in reversed(list(enumerate(frames)))
             if (number := sets.get(each.name)) is not None}  # fmt: skip
    order = sorted(range(len(frames)), key=lambda index: (first.get(sets.get(frames[index].name, -1), index), index))
    now_s = time.monotonic()
    return [ArrivedKeyframe(keyframes[index], now_s, sets.get(frames[index].name)) for index in order]


def _format_keyframe_count(number: int) -> str:
    return "1 keyframe is" if number == 1 else f"{number} keyframes are"


# Finishes the scenes of inactive submaps, oldest first, from their checkpoints.
#
# First every submap is verified with all its evidence, and compared with those that were verified before it: that tells
# where the robot is. Then their scenes are made, which takes longer.


AGAIN_S = 300.0  # after a submap could not be finished

_Step = Callable[[Store, checkpoint.RestoredReconstruction, RunContext], bool]


class InactiveSubmaps:
    def __init__(
        self,
        here: Store,
        config: ReconstructionConfig,
        output: Output,
        loop_detector: LoopDetector,
        fallback_s: float = math.inf,
        meter: WorkMeter | None = None,
    ) -> None:
        """`here` is the checkpoint which has left/ in it, `config` how scenes are made.

        Fallbacks take at most `fallback_s` seconds of each step with a submap.
        """
        self._here, self._config, self._output, self._loop_detector = here, config, output, loop_detector
        self._fallback_s, self._meter = fallback_s, meter or WorkMeter()
        self._work: IncrementalReconstruction | None = None  # that is being finished
        self._not_before_s: dict[Path, float] = {}  # monotonic, for those that could not be finished
        self._retract_after_s = -math.inf  # monotonic: a keyframe could not be taken out before

    @property
    def num_unfinished(self) -> int:
        """Counts the inactive submaps that are not finished."""
        return len(ledger.list_left_folders(self._here.directory))

    def exclude_seconds(self, seconds: float) -> None:
        """Excludes these seconds, which were spent on other work, from the report."""
        if self._work is not None:
            self._work.clock.leave_out(seconds)

    def verify_next(self, run: RunContext) -> bool:
        """Judges the oldest submap that is not verified yet with all its evidence, and compares it with the others.

        Its scene stays a draft, in a result folder, unless there is none to be made. False where there is none to be
        judged now. What inactive submaps are to lose is taken out of them first. What a pause raises ends the
        work; it is begun again another time, as after a failure.
        """
        self._remove_keyframes()
        return self._process_first(
            [each for each in self._pending_folders if not self._loop_detector.has_scene(each.name)],
            self._verify,
            run,
            Work.JUDGE,
        )

    def finalize_next(self, run: RunContext) -> bool:
        """Makes the scene of the oldest submap that is verified, as good as it gets, and writes its result.

        False where there is none to be made now; `run` as for `verify_next`.
        """
        return self._process_first(
            [each for each in self._pending_folders if self._loop_detector.has_scene(each.name)],
            self._finalize,
            run,
            Work.FINISH,
        )

    @property
    def _pending_folders(self) -> list[Path]:
        """The folders of the submaps that are not finished, the oldest first; not those that failed a moment ago."""
        now = time.monotonic()
        return [
            each for each in ledger.list_left_folders(self._here.directory) if self._not_before_s.get(each, 0.0) <= now
        ]

    @property
    def num_unjudged(self) -> int:
        """Counts the inactive submaps that are not verified."""
        return sum(
            not self._loop_detector.has_scene(each.name) for each in ledger.list_left_folders(self._here.directory)
        )

    def _process_first(self, folders: Sequence[Path], step: _Step, run: RunContext, work: Work) -> bool:
        """Takes the step with the first of the submaps; False where there is none, or the disk did not take it."""
        if not folders:
            return False
        folder = folders[0]
        self._not_before_s[folder] = time.monotonic() + AGAIN_S
        try:
            with contextlib.closing(Store(folder)) as store, self._meter.measure(work):
                found = checkpoint.restore(store, self._config)
                self._work = found.work
                give_back_memory()
                with found.work.fallback_budget(self._fallback_s):
                    done = step(store, found, run)
        except OSError as error:
            raise_shortage(error)
            self._output.complain(
                f"{folder.name} cannot be finished ({error.strerror or error}): make room on the disk"
            )
            return False
        finally:
            self._work = None
            give_back_memory()
        if done:
            del self._not_before_s[folder]
        return True

    def _remove_keyframes(self) -> None:
        """Takes out of the inactive submaps what they are to lose; their scenes are not final then."""
        if time.monotonic() < self._retract_after_s:
            return
        for scene, name in self._here.ledger.retracted:
            try:
                self._remove_keyframe(scene, name)
            except OSError as error:
                raise_shortage(error)
                self._output.complain(
                    f"{name} cannot be taken out of {scene} ({error.strerror}): make room on the disk"
                )
                self._retract_after_s = time.monotonic() + AGAIN_S
                return

    def _remove_keyframe(self, scene: str, name: str) -> None:
        """Raises OSError."""
        folder = ledger.reopen(self._here.directory, scene)
        if folder is not None:
            self._loop_detector.remove_scene(scene)
            ledger.remove_rebuild_requests(folder, "codes")
            self._not_before_s.pop(folder, None)
            try:
                with contextlib.closing(Store(folder)) as store:
                    store.forget_frames(store.find_frame_set(name, self._config.frame_set_tolerance_s), "retracted")
            except CheckpointError as error:
                raise_shortage(error)
                self._output.complain(f"{name} cannot be taken out of {scene}: {error}")
        self._here.confirm_removal(scene, name)

    def _verify(self, store: Store, found: checkpoint.RestoredReconstruction, run: RunContext) -> bool:
        """Whether the submap is verified now, and its result written."""
        work = found.work
        # As it was when the camera left
        if found.final and not found.new and not submap.split_submaps(work, store, self._output, run):
            self._output.mark_finished(store.scene_id)
        else:
            event(log, logging.INFO, "judging", scene=store.scene_id)
            self._verify_keyframes(store, found, run)
            self._output.save_fallbacks(store, work)
            if not work.estimate_soon(run).publishable:
                return self._finalize(store, found, run)
            work.update(run)
            snapshot = work.snapshot(store.frames_dropped, final=False)
            if not self._output.export(snapshot, work, store, SubmapState.LEFT, work.names):
                return False
            self._output.save(store, work, final=False)
        work.release_scene()  # the checkpoint has it, and comparing takes memory, too
        give_back_memory()
        self._loop_detector.add_scene(
            store, work.graph, self._loop_detector.detect_loops(store.scene_id, work.graph, run)
        )
        return True

    def _verify_keyframes(self, store: Store, found: checkpoint.RestoredReconstruction, run: RunContext) -> None:
        """All evidence on all keyframes; those that do not belong to the submap are forgotten."""
        work = found.work

        def forget(name: str, reason: str) -> None:
            store.forget(name, reason)
            work.remove_keyframes([name])

        for keyframe in submap.screen_keyframes(work, found.new, forget):  # that came shortly before the camera left
            work.add_keyframe(keyframe, run)
        submap.verify_keyframes(work, forget, run)
        if submap.split_submaps(work, store, self._output, run):
            work.estimate_thoroughly(run)
        for keyframe in work.keyframes_deferred:
            forget(keyframe.name, "it does not fit the scene")

    def _finalize(self, store: Store, found: checkpoint.RestoredReconstruction, run: RunContext) -> bool:
        """Whether the scene of a verified submap is final now, and its result written."""
        work = found.work
        if not found.final:
            event(log, logging.INFO, "finishing", scene=store.scene_id)
            work.release_scene()  # it is made anew
            work.show(_refine_to_end(work, self._config, run))
            work.estimate_soon(run)
            snapshot = work.snapshot(store.frames_dropped, final=True)
            if not self._output.export(snapshot, work, store, SubmapState.FINISHED, work.names):
                return False
            self._output.save(store, work, final=True)
        if work.scene is None:  # one that is refused is of no use later
            self._loop_detector.remove_scene(store.scene_id)
            ledger.remove_left_checkpoint(store.directory)
        else:
            store.remove_scene_files()
            store.finalize()
        return True


def _refine_to_end(work: IncrementalReconstruction, config: ReconstructionConfig, run: RunContext) -> SceneWithVerdict:
    show = SceneWithVerdict()
    for show in submap.refine(work, config, run):  # noqa: B007
        pass
    return show
