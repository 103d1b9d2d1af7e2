"""The active submap: keyframes are worked in, the scene grows, is shown, and becomes as good as it gets.

Whether a keyframe belongs to the submap has a quick answer at once, and a thorough one in the end; so has which views
can be spared. A keyframe that does not fit at once is set aside, out of the scene: it may spoil it. It belongs all the
same where all keyframes, estimated together as an offline run estimates them, make a scene: a later one may have
joined it.
"""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

from splatnode.capture.process.system import is_shortage
from splatnode.capture.process.terminal import ProgressStep, event
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon import ReconState, Work, WorkMeter, checkpoint, weigh_final
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.ingest import ArrivedKeyframe
from splatnode.recon.daemon.loop_closure import LoopDetector
from splatnode.recon.daemon.output import Output, describe_submap
from splatnode.recon.daemon.relocalization import FinalScene
from splatnode.recon.daemon.submap_index import SubmapRecord, SubmapState
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.modelling import SceneWithVerdict, limit_refinement
from splatnode.recon.registration.rigs import form_sets
from splatnode.recon.result import snapshot as result_snapshot
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.threads import BACKGROUND, RunContext

NEWEST = 3  # keyframes that are never given up: what comes next connects to them
MIN_SUBMAP_KEYFRAMES = 3  # keyframes that may be a submap of their own
MIN_KEPT_CAMERAS = 0.6  # share of a scene's cameras that a merged scene must keep to count as the same scene


def add(work: IncrementalReconstruction, keyframes: Sequence[Keyframe], run: RunContext = BACKGROUND) -> set[str]:
    """Adds keyframes to the reconstruction; sets those aside that do not fit the scene at once, and names them.

    Where there is no scene that may be published there is nothing that they could fit, and all of them are kept.
    """
    standing = _find_placed(work, run)
    for keyframe in keyframes:
        work.add_keyframe(keyframe, run)
    if not standing:
        return set()
    names = [keyframe.name for keyframe in keyframes]
    if _fits(work, names):
        return set()
    work.defer_keyframes(names)
    return {name for name in names if len(names) == 1 or not _fits_alone(work, name)}


def join(work: IncrementalReconstruction, names: Iterable[str], run: RunContext = BACKGROUND) -> bool:
    """Brings keyframes back that were set aside, if all are a scene together: this one, estimated thoroughly.

    Some of them may still be without a camera then. A pause may raise to abandon the work, and they stay aside.
    """
    names = set(names)
    if not names or work.is_rejected(names.union(work.names)):
        return False
    standing = _find_placed(work, run)
    work.restore_keyframes(names)
    try:
        placed = work.estimate_thoroughly(run).publishable_camera_names
    except BaseException:
        work.defer_keyframes(names)
        raise
    if placed and len(placed & standing) >= MIN_KEPT_CAMERAS * len(standing):
        return True
    work.defer_keyframes(names)
    return False


def has_links_to_deferred(work: IncrementalReconstruction, run: RunContext = BACKGROUND) -> bool:
    """Whether any verified pairs lead from the scene to what was set aside; without them nothing can join the two."""
    placed, aside = _find_placed(work, run), {keyframe.name for keyframe in work.keyframes_deferred}
    work.restore_keyframes(aside)
    try:
        work.match_pending_pairs(run)
        groups = [{work.names[index] for index in group} for group in work.graph.components()]
    finally:
        work.defer_keyframes(aside)
    return any(not group.isdisjoint(placed) and not group.isdisjoint(aside) for group in groups)


def find_separate_groups(work: IncrementalReconstruction, run: RunContext = BACKGROUND) -> list[list[Keyframe]]:
    """Returns groups of keyframes that verified pairs join to each other, and to none of the scene.

    Where there is no scene, what most keyframes show counts as it. Those that were set aside are asked, too.
    """
    placed, aside = (
        work.estimate_soon(run).publishable_camera_names,
        {keyframe.name for keyframe in work.keyframes_deferred},
    )
    work.restore_keyframes(aside)
    try:
        work.match_pending_pairs(run)
        groups = [[work.graph.keyframes[index] for index in group] for group in work.graph.components()]
    finally:
        work.defer_keyframes(aside)
    here = placed or {keyframe.name for group in groups[:1] for keyframe in group}
    others = [group for group in groups if here.isdisjoint(keyframe.name for keyframe in group)]
    return [group for group in others if len(group) >= MIN_SUBMAP_KEYFRAMES]


def is_split(work: IncrementalReconstruction, run: RunContext = BACKGROUND) -> bool:
    """Whether the keyframes show several places: groups that verified pairs join to each other, and to no other."""
    work.match_pending_pairs(run)
    return sum(len(group) > 1 for group in work.graph.components()) > 1


def verify_provisional(work: IncrementalReconstruction, run: RunContext = BACKGROUND) -> None:
    """Estimates thoroughly what was added provisionally and what was set aside: together, else one after the other.

    Keyframes by which the scene fails are set aside. A pause may raise to abandon the work; what was not estimated by
    then is aside, or as it was.
    """
    if join(work, _list_names(work.keyframes_deferred), run):
        return
    estimate = work.estimate_thoroughly(run)
    if not work.publishable_names:
        return
    if not estimate.verdict.publishable:
        work.defer_keyframes(set(work.names) - work.publishable_names)
        work.estimate_thoroughly(run)
    for name in _list_names(work.keyframes_deferred):
        join(work, [name], run)


def find_untracked(work: IncrementalReconstruction, run: RunContext = BACKGROUND) -> list[Keyframe]:
    """The last keyframes in a row, as their frames came, that have no camera in the scene that there is."""
    placed = _find_placed(work, run)
    if not placed:
        return []
    everyone = sorted([*work.graph.keyframes, *work.keyframes_deferred], key=lambda keyframe: keyframe.frame.frame_id)
    last = max(index for index, keyframe in enumerate(everyone) if keyframe.name in placed)
    return everyone[last + 1 :]


def find_contradicting(work: IncrementalReconstruction, run: RunContext = BACKGROUND) -> list[Keyframe]:
    """Keyframes that were set aside, after which others fitted."""
    last = _list_names(find_untracked(work, run))
    return (
        [keyframe for keyframe in work.keyframes_deferred if keyframe.name not in last]
        if _find_placed(work, run)
        else []
    )


def select_newest(work: IncrementalReconstruction, count: int) -> list[Keyframe]:
    """So many keyframes of the scene, of those whose frames came last; more where these leave part of a frame set."""
    ordered = sorted(work.graph.keyframes, key=lambda keyframe: keyframe.frame.frame_id)
    newest = ordered[-max(count, NEWEST) :]
    together = find_frame_sets(work, [keyframe.name for keyframe in newest])
    return [keyframe for keyframe in ordered if keyframe in newest or keyframe.name in together]


def find_frame_sets(work: IncrementalReconstruction, names: Collection[str]) -> set[str]:
    """The keyframes, and those of the scene that other cameras took together with them."""
    sets = (set(each.names.values()) for each in form_sets(work.graph.keyframes, work.config.frame_set_tolerance_s))
    return set(names).union(*(each for each in sets if not each.isdisjoint(names)))


def find_most_redundant(graph: ViewGraph) -> str:
    """The older keyframe of the pair that has most in common, the newest ones left out."""
    old = len(graph.keyframes) - NEWEST
    shared = {pair: len(view.matches) for pair, view in graph.pairs.items() if pair[0] < old}
    first = max(shared, key=lambda pair: (shared[pair], -pair[0]))[0] if shared else 0
    return graph.keyframes[first].name


def _fits_alone(work: IncrementalReconstruction, name: str) -> bool:
    """Whether a keyframe that was set aside fits at once; it is brought back then."""
    work.restore_keyframes([name])
    if _fits(work, [name]):
        return True
    work.defer_keyframes([name])
    return False


def _fits(work: IncrementalReconstruction, names: Collection[str]) -> bool:
    estimate = work.estimate_quickly()
    return estimate is not None and estimate.publishable_camera_names.issuperset(names)


def _find_placed(work: IncrementalReconstruction, run: RunContext) -> set[str]:
    """The keyframes that have a camera in the scene that there is, if it may be published."""
    return work.estimate_soon(run).publishable_camera_names if work.scene is not None else set()


def _list_names(keyframes: Iterable[Keyframe]) -> list[str]:
    return [keyframe.name for keyframe in keyframes]


# What is done alike for the active submap, and for an inactive one.
#
# Keyframes are screened; in the end all evidence is weighed, and the scene is made afresh and refined.

log = logging.getLogger(__name__)

STEP = 10  # iterations between pauses

Forget = Callable[[str, str], None]  # a keyframe's name, and why


def screen_keyframes(work: IncrementalReconstruction, keyframes: Iterable[Keyframe], forget: Forget) -> list[Keyframe]:
    """Those of the keyframes that show something new, and sharply; what does not is forgotten."""
    kept: list[Keyframe] = []
    for keyframe in keyframes:
        gone = {each.name: each.reason for each in work.screen(keyframe.frame)}
        kept = [each for each in (*kept, keyframe) if each.name not in gone]
        for name, reason in gone.items():
            event(log, logging.INFO, "left_out", frame=name, reason=reason)
            forget(name, reason)
    return kept


def verify_keyframes(work: IncrementalReconstruction, forget: Forget, run: RunContext) -> None:
    """Estimates thoroughly which keyframes belong to the submap; those that contradict it are forgotten."""
    verify_provisional(work, run)
    for keyframe in find_contradicting(work, run):
        forget(keyframe.name, "it contradicts the scene")


def split_submaps(
    work: IncrementalReconstruction, store: Store, output: Output, run: RunContext, present: bool = False
) -> bool:
    """Makes submaps, which wait, of keyframes that show other places; returns whether there were any.

    `present`: the camera is in this submap.
    """
    groups = find_separate_groups(work, run)
    for keyframes in groups:
        names = _list_names(keyframes)
        scene = store.split_off(names, present=present)
        output.add_split_submap(scene, names)
        event(log, logging.INFO, "parted", scene=store.scene_id, part=scene, keyframes=len(names))
        work.remove_keyframes(names)
    return bool(groups)


def refine(
    work: IncrementalReconstruction, config: ReconstructionConfig, run: RunContext
) -> Iterator[SceneWithVerdict]:
    """The scene of all keyframes at every checkpoint, and at the end; it is not shown yet.

    Yields nothing where the verdict forbids a scene. A pause in between may raise to abandon the work.
    """
    run.tell(ProgressStep("estimating depth"))
    work.rebuild(run)
    steps, optimize = itertools.count(1), limit_refinement(config, work.initial_scene).optimize

    def pause_periodically() -> None:
        done = next(steps)
        run.tell(ProgressStep("refining the scene", done, optimize.steps, "step"))
        if done % STEP == 0:
            run.pause()

    yield from work.refine(work.initial_scene, optimize, RunContext(pause_periodically))


# The result of the active submap's final scene: written when the scene is, or when the disk takes it again.

AGAIN_S = 60.0  # after the disk did not take it


class FinalResult:
    def __init__(self, store: Store, output: Output) -> None:
        self._store, self._output = store, output
        self._not_before_s = -math.inf  # monotonic
        self.names: frozenset[str] = frozenset()  # the keyframes whose scene was written as final

    def write(self, snapshot: Snapshot, work: IncrementalReconstruction) -> bool:
        """Writes the scene as the final one of its keyframes; False where the disk does not take it."""
        written = self._output.export(snapshot, work, self._store, SubmapState.HERE, sorted(self._store.names))
        # What is kept as final is not exported after a restart.
        self._output.save(self._store, work, final=written)
        self.names = frozenset(work.names) if written else frozenset()
        self._not_before_s = time.monotonic() + AGAIN_S
        return written

    def retry_write(self, shown: Snapshot | None, work: IncrementalReconstruction, at_once: bool) -> bool:
        """Writes a final scene that is shown and that the disk did not take; False where there is none, or not now."""
        if shown is None or not shown.final or self.names == frozenset(work.names):
            return False
        return (at_once or time.monotonic() >= self._not_before_s) and self.write(shown, work)


PATIENCE_S = 3.0  # that a thorough judgement of a keyframe that does not fit may keep others waiting
MOST_ASIDE = 8  # keyframes that may still find their place
SHARED_PART = 3  # of the views of a scene that is full, one in so many is in the next one, too: the newest


class Abandoned(Exception):
    """Something more urgent has come."""


class ActiveSubmap:
    def __init__(
        self,
        config: DaemonConfig,
        recipe: ReconstructionConfig,
        store: Store,
        output: Output,
        pause: Callable[[float], None],
        meter: WorkMeter | None = None,
    ) -> None:
        """`pause` raises Abandoned if the daemon stops, and from a time (monotonic) on if something has come."""
        self._config, self._recipe, self._store, self._output = config, recipe, store, output
        self._meter = meter or WorkMeter()
        self._pause_until = pause
        # Raises Abandoned if the daemon stops, or something has come
        self._until_disturbed = RunContext(partial(pause, -math.inf))
        # Raises Abandoned if the daemon stops: what may be shown soon is not abandoned for what comes next
        self._until_stopped = RunContext(partial(pause, math.inf))
        self._work = IncrementalReconstruction(recipe)
        self._final = FinalResult(store, output)
        self._compared: frozenset[str] = frozenset()  # those of the scene that was compared with the finished ones
        self._exported_s = time.monotonic()
        self._fallbacks: tuple[tuple[str, str], ...] = ()  # those without a gain that the checkpoint has
        self._shown: Snapshot | None = None  # last
        self.record: SubmapRecord | None = None  # of what was shown last, also where no file has it yet
        self.settled = True  # nothing can be made better before the next keyframe
        self.under_way: list[ArrivedKeyframe] = []  # keyframes that are being worked in, and that no scene shows yet
        self.owed: list[ArrivedKeyframe] = []  # keyframes that a step that failed did not work in
        self.state = ReconState.WAITING
        self.keyframe_s: float | None = None  # from the last keyframe's arrival until the scene showed it
        self.finished: FinalScene | None = None  # while no keyframe waits

    def resume(self, found: checkpoint.RestoredReconstruction) -> None:
        """Goes on where an earlier process was. Keyframes that it did not work in come as if they had just arrived."""
        self._work = found.work
        self.settled = found.final or not found.keyframes
        self._final.names = frozenset(self._work.names) if found.final else frozenset()
        if not found.keyframes:
            return
        event(log, logging.INFO, "restored", scene=self._store.scene_id, keyframes=found.keyframes, new=len(found.new))
        self.settled = self.settled and not found.new
        self.state = ReconState.IDLE if self.settled else ReconState.GROWING
        if self._work.scene is not None:
            self._show(final=self.settled)
        elif not found.new:
            self.add_keyframes([])

    def add_keyframes(self, arrived: Sequence[ArrivedKeyframe]) -> None:
        """Keyframes that have come, shown together where all belong to one submap, else one after the other.

        So the same submaps come of them as if each had come by itself: of keyframes that waited, those of the next
        submaps would else begin one together.
        """
        self.state, self.settled, self.finished = ReconState.GROWING, False, None
        self.owed = self.under_way = self._prepend_retries(arrived)
        try:
            apart = self._add_together(self.owed)
            self.owed = self.under_way = apart
            while self.owed:
                one, *later = self.owed
                self._add_one(one, later)
        finally:
            self.under_way = self.owed
            self._save_fallbacks()
        self.state = ReconState.LOST if self._find_untracked() else ReconState.GROWING

    def _add_together(self, arrived: Sequence[ArrivedKeyframe]) -> list[ArrivedKeyframe]:
        """Works in keyframes, and returns those that are to be worked in one after the other, which it leaves out."""
        if len(arrived) == 1:
            return list(arrived)
        keyframes = screen_keyframes(self._work, (each.keyframe for each in arrived), self._forget)
        standing = self._work.scene is not None
        strangers = self._add_to_graph(keyframes)
        if not standing and keyframes and is_split(self._work, self._until_stopped):
            strangers = {keyframe.name for keyframe in keyframes}
        self._work.remove_keyframes(strangers)  # they are screened again
        apart = [each for each in arrived if each.keyframe.name in strangers]
        self.owed = apart
        if not strangers or len(strangers) < len(keyframes):
            self._update_and_show(arrived)
        return apart

    def _add_one(self, arrived: ArrivedKeyframe, later: list[ArrivedKeyframe]) -> None:
        """Works a keyframe in; `later` are those that follow it."""
        keyframes = screen_keyframes(self._work, [arrived.keyframe], self._forget)
        strangers = self._add_to_graph(keyframes)
        self.owed = later
        if not strangers or self._rejoin_deferred(strangers):
            self._update_and_show([arrived])
        self.under_way = later

    def _prepend_retries(self, arrived: Sequence[ArrivedKeyframe]) -> list[ArrivedKeyframe]:
        """Also those keyframes that a step that failed left out, and that nobody has removed since."""
        there = {*self._work.names, *(keyframe.name for keyframe in self._work.keyframes_deferred)}
        owed = [each for each in self.owed if each.keyframe.name in self._store.names - there]
        self._work.remove_keyframes([each.keyframe.name for each in owed])  # they were screened, and are screened again
        return [*owed, *arrived]

    def _update_and_show(self, arrived: Sequence[ArrivedKeyframe]) -> None:
        """The scene with the keyframes that have come to belong to it."""
        self._limit_views()
        self._work.update(self._until_stopped)
        snapshot = self._show()
        if arrived:
            self.keyframe_s = time.monotonic() - arrived[0].at_s
        event(
            log, logging.INFO, "keyframes", names=",".join(each.keyframe.name for each in arrived),
            verdict=snapshot.verdict.code.value, gaussians=len(snapshot.gaussians), seconds=self.keyframe_s or 0.0,
            bounds=result_snapshot.format_widest_bounds(snapshot.cameras, snapshot.scale),
        )  # fmt: skip
        self._output.save(self._store, self._work, final=False)
        if time.monotonic() - self._exported_s >= self._config.export_interval_s:
            self.export_provisionally()
        give_back_memory()

    def _add_to_graph(self, keyframes: list[Keyframe]) -> set[str]:
        """Adds keyframes to the view graph; names those that do not fit at once, which are set aside."""
        try:
            return add(self._work, keyframes, self._until_stopped)
        except Abandoned:
            raise
        except Exception as error:  # one bad frame must not keep others out
            if is_shortage(error):
                raise
            self._work.remove_keyframes([keyframe.name for keyframe in keyframes])
            if len(keyframes) > 1:
                return set().union(*(self._add_to_graph([keyframe]) for keyframe in keyframes))
            log.exception("%s cannot be worked in", keyframes[0].name)
            self._forget(keyframes[0].name, f"cannot be worked in: {error}")
            return set()

    def _rejoin_deferred(self, newest: set[str]) -> bool:
        """Whether the scene changes by keyframes that did not fit at once. Raises Abandoned.

        They are judged thoroughly with all others, as long as what waits can wait; if they are too many, in any case.
        If that does not help, another submap begins with them.
        """
        lost = len(self._find_untracked()) >= self._config.new_submap_after
        soon = math.inf if lost else time.monotonic() + PATIENCE_S
        run = RunContext(partial(self._pause_until, soon))
        aside = [keyframe.name for keyframe in self._work.keyframes_deferred]
        joined = has_links_to_deferred(self._work, run) and (
            join(self._work, aside, run) or (not lost and join(self._work, newest, run))
        )
        if self._check_lost(newest):
            return True
        for keyframe in self._work.keyframes_deferred[: -max(MOST_ASIDE, self._config.new_submap_after)]:
            self._forget(keyframe.name, "it does not fit the scene")
        return joined

    def _check_lost(self, newest: Collection[str]) -> bool:
        """Says which of the newest keyframes do not fit; where too many in a row do not, another submap begins."""
        strangers = self._find_untracked()
        for keyframe in strangers:
            if keyframe.name in newest:
                event(log, logging.WARNING, "does_not_fit", frame=keyframe.name, scene=self._store.scene_id)
        if len(strangers) < self._config.new_submap_after:
            return False
        self._begin_submap(strangers)
        return True

    def _begin_submap(self, strangers: Sequence[Keyframe]) -> None:
        """Another scene begins with the frames that do not belong to the present one, which is finished later."""
        self.state = ReconState.LOST
        before = self._leave_submap(strangers[0].frame.frame_id)
        event(log, logging.WARNING, "another_place", before=before, now=self._store.scene_id)
        self._work = IncrementalReconstruction(self._recipe)
        for keyframe in strangers:
            self._work.add_keyframe(keyframe, self._until_stopped)

    def _leave_submap(self, first: int, shared: Collection[str] = ()) -> str:
        """Begins another scene with frame `first`; the present one, whose id is returned, is finished later.

        The frames before it belong to the present scene alone, those that are `shared` to both.
        """
        before, kept = self._store.scene_id, self._store.names_before(first).union(shared)
        if self._final.names != kept:
            self._output.save(self._store, self._work, final=False)
            self._export_provisionally(SubmapState.LEFT, kept)
        else:
            self._output.mark_finished(before)
        self._store.leave_submap(first, shared)
        self._final.names, self._compared, self._shown, self.record = frozenset(), frozenset(), None, None
        return before

    def export_provisionally(self) -> None:
        """Writes what is shown, unless it was written as final."""
        if not self.retry_write(at_once=True):
            self._export_provisionally(SubmapState.HERE, self._store.names)

    def retry_write(self, at_once: bool = False) -> bool:
        """Writes the finished scene that the disk did not take; False where there is none, or it was tried just now."""
        return self._final.retry_write(self._shown, self._work, at_once)

    def _export_provisionally(self, state: SubmapState, names: Collection[str]) -> None:
        """`names` are those of the submap's keyframes."""
        self._exported_s = time.monotonic()
        if self._shown is None or self._shown.final:
            return
        kept = sorted(names)
        if self._shown.verdict.publishable:
            self._output.export(self._shown, self._work, self._store, state, kept)
        else:
            self._output.update_index(self._shown, state, kept)

    def _begin_overlapping_submap(self) -> None:
        """Begins the next scene of the same walk with the newest views, which both scenes have; the first is left.

        Not where the newest alone make no scene.
        """
        newest = select_newest(self._work, self._config.max_views // SHARED_PART)
        first = min(each.frame.frame_id for each in newest)
        work = IncrementalReconstruction(self._recipe, self._work.state)
        # Also what was set aside before: it stays with the scene that is left.
        work.remove_keyframes(
            [each.name for each in (*work.graph.keyframes, *work.keyframes_deferred) if each.frame.frame_id < first]
        )
        if len(work.estimate_thoroughly(self._until_stopped).publishable_camera_names) < len(newest):
            return
        shared = {each.name for each in newest}
        before = self._leave_submap(first, shared=shared)
        event(log, logging.INFO, "next_scene", before=before, now=self._store.scene_id, shared=len(newest))
        self._work = work

    def _limit_views(self) -> None:
        """Sees to it that there are not more views than configured: goes on with the newest, else gives up others."""
        if len(self._work.names) > self._config.max_views:
            self._begin_overlapping_submap()
        while len(self._work.names) > max(self._config.max_views, NEWEST):
            names = find_frame_sets(self._work, [find_most_redundant(self._work.graph)])
            event(log, logging.INFO, "given_up", frame=",".join(sorted(names)))
            self._store.forget_frames(names, "given up for newer views that show the same")
            self._work.remove_keyframes(names)

    def detect_loops(self, atlas: LoopDetector) -> bool:
        """Links the scene with finished ones that show the same, if it is final and was not compared before.

        False where there was nothing to compare. Raises Abandoned.
        """
        names = frozenset(self._work.names)
        if not names or self._final.names != names or self._compared == names:
            return False
        state, self.state, self._compared = self.state, ReconState.REFINING, names
        try:
            atlas.detect_loops(self._store.scene_id, self._work.graph, self._until_disturbed)
        except Abandoned:
            self._compared = frozenset()  # only this is worth another time
            raise
        finally:
            self.state = state
        return True

    def remove_frames(self, names: Sequence[str]) -> None:
        """The checkpoint no longer has these frames; the scene forgets them, too."""
        known = [name for name in names if name in self._work.names]
        self._work.remove_keyframes(names)
        if known:
            self.settled, self.finished, self.state = False, None, ReconState.GROWING
        self._show(final=self.settled and self._work.scene is not None)
        if known:
            self._output.save(self._store, self._work, final=False)

    def _forget(self, name: str, reason: str) -> None:
        self._store.forget(name, reason)
        self._work.remove_keyframes([name])

    def finalize(self) -> None:
        """Makes the scene afresh from all keyframes and refines it. Raises Abandoned when something comes."""
        self.state = ReconState.REFINING
        with self._meter.measure(Work.FINAL, weigh_final(len(self._work.names))):
            self._meter.tell(ProgressStep("finding and checking the cameras"))
            self._verify()
            self._refine_verified()

    def _verify(self) -> None:
        """Weighs all evidence; what shows other places begins submaps, or becomes submaps of its own that wait."""
        more = True
        while more:
            fitted = set(self._work.names)
            with self._work.fallback_budget(self._config.fallback_timeout_s):
                try:
                    verify_keyframes(self._work, self._forget, self._until_disturbed)
                finally:
                    self._save_fallbacks()
            more = self._check_lost(fitted)
        split_submaps(self._work, self._store, self._output, self._until_disturbed, present=True)

    def _save_fallbacks(self) -> None:
        """Writes into the checkpoint which fallbacks gained nothing, where there are others than before."""
        if self._work.state.memory.fruitless != self._fallbacks:
            self._fallbacks = self._work.state.memory.fruitless
            self._output.save_fallbacks(self._store, self._work)

    def _refine_verified(self) -> None:
        refined = SceneWithVerdict()
        for refined in refine(self._work, self._recipe, replace(self._until_disturbed, tell=self._meter.tell)):
            if refined.scene is not None and refined.scene.iterations in self._recipe.optimize.checkpoints:
                self._work.show(refined)
                self._show()
        self.settled = True
        self._work.show(refined)
        shown = self._work.scene is not None
        snapshot = self._show(final=shown)
        if shown:
            self._final.write(snapshot, self._work)
        else:
            self._output.update_index(snapshot, SubmapState.HERE, sorted(self._store.names))
        self.state = ReconState.WAITING if not shown else ReconState.LOST if self._find_untracked() else ReconState.IDLE
        give_back_memory()

    def _find_untracked(self) -> list[Keyframe]:
        return find_untracked(self._work, self._until_stopped)

    def _show(self, final: bool = False) -> Snapshot:
        self._work.estimate_soon(self._until_stopped)
        snapshot = self._work.snapshot(self._store.frames_dropped, final)
        measured = self._output.publish(snapshot, self._work)
        self.finished, self._shown = FinalScene(measured, self._work.graph.keyframes) if final else None, snapshot
        self.record = describe_submap(self._store, SubmapState.HERE, None, snapshot, sorted(self._store.names))
        return snapshot
