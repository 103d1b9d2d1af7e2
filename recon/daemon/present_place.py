"""The place where the camera is: keyframes are worked in, the scene grows, is shown, and becomes as good as it gets."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial

from splatnode.capture.process.logs import event
from splatnode.capture.process.memory_shortage import is_shortage
from splatnode.recon.config import Config as Recipe
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon import finishing, membership, places
from splatnode.recon.daemon.atlas.atlas import Atlas
from splatnode.recon.daemon.checkpoint import checkpoint
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.config import Config
from splatnode.recon.daemon.final_result import FinalResult
from splatnode.recon.daemon.inbox import Arrived
from splatnode.recon.daemon.output import Output
from splatnode.recon.daemon.status import State
from splatnode.recon.daemon.watcher import Finished
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.modelling import Shown
from splatnode.recon.result import bounds_in_words
from splatnode.recon.result.snapshot import Snapshot

log = logging.getLogger(__name__)

PATIENCE_S = 3.0  # that a thorough judgement of a keyframe that does not fit may keep others waiting
MOST_ASIDE = 8  # keyframes that may still find their place
SHARED_PART = 3  # of the views of a scene that is full, one in so many is in the next one, too: the newest


class Abandoned(Exception):
    """Something more urgent has come."""


class PresentPlace:
    def __init__(
        self, config: Config, recipe: Recipe, store: Store, output: Output, pause: Callable[[float], None]
    ) -> None:
        """`pause` raises Abandoned if the daemon stops, and from a time (monotonic) on if something has come."""
        self._config, self._recipe, self._store, self._output = config, recipe, store, output
        self._pause_until = pause
        self._work = IncrementalReconstruction(recipe)
        self._final = FinalResult(store, output)
        self._compared: frozenset[str] = frozenset()  # those of the scene that was compared with the finished ones
        self._exported_s = time.monotonic()
        self._fallbacks: tuple[tuple[str, str], ...] = ()  # those without a gain that the checkpoint has
        self._shown: Snapshot | None = None  # last
        self.settled = True  # nothing can be made better before the next keyframe
        self.under_way: list[Arrived] = []  # keyframes that are being worked in, and that no scene shows yet
        self.owed: list[Arrived] = []  # keyframes that a step that failed did not work in
        self.state = State.WAITING
        self.keyframe_s: float | None = None  # from the last keyframe's arrival until the scene showed it
        self.finished: Finished | None = None  # while no keyframe waits

    def go_on(self, found: checkpoint.Restored) -> None:
        """Goes on where an earlier process was. Keyframes that it did not work in come as if they had just arrived."""
        self._work = found.work
        self.settled = found.final or not found.keyframes
        self._final.names = frozenset(self._work.names) if found.final else frozenset()
        if not found.keyframes:
            return
        event(log, logging.INFO, "restored", scene=self._store.scene_id, keyframes=found.keyframes, new=len(found.new))
        self.settled = self.settled and not found.new
        self.state = State.IDLE if self.settled else State.GROWING
        if self._work.scene is not None:
            self._show(final=self.settled)
        elif not found.new:
            self.take_in([])

    def take_in(self, arrived: Sequence[Arrived]) -> None:
        """Keyframes that have come, shown together where all belong to one place, else one after the other.

        So the same places come of them as if each had come by itself: of keyframes that waited, those of the next
        places would else begin one together.
        """
        self.state, self.settled, self.finished = State.GROWING, False, None
        self.owed = self.under_way = self._with_those_before(arrived)
        try:
            apart = self._take_in_together(self.owed)
            self.owed = self.under_way = apart
            while self.owed:
                one, *later = self.owed
                self._take_in_one(one, later)
        finally:
            self.under_way = self.owed
            self._keep_fallbacks()
        self.state = State.LOST if self._strangers() else State.GROWING

    def _take_in_together(self, arrived: Sequence[Arrived]) -> list[Arrived]:
        """Works in keyframes, and returns those that are to be worked in one after the other, which it leaves out."""
        if len(arrived) == 1:
            return list(arrived)
        keyframes = finishing.screened(self._work, (each.keyframe for each in arrived), self._forget)
        standing = self._work.scene is not None
        strangers = self._added(keyframes)
        if not standing and keyframes and membership.is_split(self._work, self._unless_stopping):
            strangers = {keyframe.name for keyframe in keyframes}
        self._work.retract(strangers)  # they are screened again
        apart = [each for each in arrived if each.keyframe.name in strangers]
        self.owed = apart
        if not strangers or len(strangers) < len(keyframes):
            self._show_grown(arrived)
        return apart

    def _take_in_one(self, arrived: Arrived, later: list[Arrived]) -> None:
        """Works a keyframe in; `later` are those that follow it."""
        keyframes = finishing.screened(self._work, [arrived.keyframe], self._forget)
        strangers = self._added(keyframes)
        self.owed = later
        if not strangers or self._receive(strangers):
            self._show_grown([arrived])
        self.under_way = later

    def _with_those_before(self, arrived: Sequence[Arrived]) -> list[Arrived]:
        """Also those keyframes that a step that failed left out, and that nobody has removed since."""
        there = {*self._work.names, *(keyframe.name for keyframe in self._work.aside)}
        owed = [each for each in self.owed if each.keyframe.name in self._store.names - there]
        self._work.retract([each.keyframe.name for each in owed])  # they were screened, and are screened again
        return [*owed, *arrived]

    def _show_grown(self, arrived: Sequence[Arrived]) -> None:
        """The scene with the keyframes that have come to belong to it."""
        self._make_room()
        self._work.update(self._unless_stopping)
        snapshot = self._show()
        if arrived:
            self.keyframe_s = time.monotonic() - arrived[0].at_s
        event(
            log, logging.INFO, "keyframes", names=",".join(each.keyframe.name for each in arrived),
            verdict=snapshot.verdict.code.value, gaussians=len(snapshot.gaussians), seconds=self.keyframe_s or 0.0,
            bounds=bounds_in_words.of_cameras(snapshot.cameras, snapshot.scale),
        )  # fmt: skip
        self._output.save(self._store, self._work, final=False)
        if time.monotonic() - self._exported_s >= self._config.export_every_s:
            self.export_provisionally()
        give_back_memory()

    def _added(self, keyframes: list[Keyframe]) -> set[str]:
        """Adds keyframes to the view graph; names those that do not fit at once, which are set aside."""
        try:
            return membership.add(self._work, keyframes, self._unless_stopping)
        except Abandoned:
            raise
        except Exception as error:  # one bad frame must not keep others out
            if is_shortage(error):
                raise
            self._work.retract([keyframe.name for keyframe in keyframes])
            if len(keyframes) > 1:
                return set().union(*(self._added([keyframe]) for keyframe in keyframes))
            log.exception("%s cannot be worked in", keyframes[0].name)
            self._forget(keyframes[0].name, f"cannot be worked in: {error}")
            return set()

    def _receive(self, newest: set[str]) -> bool:
        """Whether the scene changes by keyframes that did not fit at once. Raises Abandoned.

        They are judged thoroughly with all others, as long as what waits can wait; if they are too many, in any case.
        If that does not help them, another place begins with them.
        """
        lost = len(self._strangers()) >= self._config.lost_after
        pause = partial(self._pause_until, math.inf if lost else time.monotonic() + PATIENCE_S)
        aside = [keyframe.name for keyframe in self._work.aside]
        joined = membership.connected(self._work, pause) and (
            membership.join(self._work, aside, pause) or (not lost and membership.join(self._work, newest, pause))
        )
        if self._lost(newest):
            return True
        for keyframe in self._work.aside[: -max(MOST_ASIDE, self._config.lost_after)]:
            self._forget(keyframe.name, "it does not fit the scene")
        return joined

    def _lost(self, newest: Collection[str]) -> bool:
        """Says which of the newest keyframes do not fit; where too many in a row do not, another place begins."""
        strangers = self._strangers()
        for keyframe in strangers:
            if keyframe.name in newest:
                event(log, logging.WARNING, "does_not_fit", frame=keyframe.name, scene=self._store.scene_id)
        if len(strangers) < self._config.lost_after:
            return False
        self._begin_place(strangers)
        return True

    def _begin_place(self, strangers: Sequence[Keyframe]) -> None:
        """Another scene begins with the frames that do not belong to the present one, which is finished later."""
        self.state = State.LOST
        before = self._leave(strangers[0].frame.frame_id)
        event(log, logging.WARNING, "another_place", before=before, now=self._store.scene_id)
        self._work = IncrementalReconstruction(self._recipe)
        for keyframe in strangers:
            self._work.add(keyframe, self._unless_stopping)

    def _leave(self, first: int, shared: Collection[str] = ()) -> str:
        """Begins another scene with frame `first`; the present one, whose id is returned, is finished later.

        The frames before it belong to the present scene alone, those that are `shared` to both.
        """
        before, kept = self._store.scene_id, self._store.names_before(first).union(shared)
        if self._final.names != kept:
            self._output.save(self._store, self._work, final=False)
            self._export_provisionally(places.State.LEFT, kept)
        else:
            self._output.finished(before)
        self._store.leave_place(first, shared)
        self._final.names, self._compared, self._shown = frozenset(), frozenset(), None
        return before

    def export_provisionally(self) -> None:
        """Writes what is shown, unless it was written as final."""
        if not self.write_refused(at_once=True):
            self._export_provisionally(places.State.HERE, self._store.names)

    def write_refused(self, at_once: bool = False) -> bool:
        """Writes the finished scene that the disk did not take; False where there is none, or it was tried just now."""
        return self._final.write_refused(self._shown, self._work, at_once)

    def _export_provisionally(self, state: places.State, names: Collection[str]) -> None:
        """`names` are those of the place's keyframes."""
        self._exported_s = time.monotonic()
        if self._shown is None or self._shown.final:
            return
        kept = sorted(names)
        if self._shown.verdict.publishable:
            self._output.export(self._shown, self._work, self._store, state, kept)
        else:
            self._output.tell(self._shown, state, kept)

    def _go_on_with_newest(self) -> None:
        """Begins the next scene of the same place with the newest views, which both scenes have; the first is left.

        Not where the newest alone make no scene.
        """
        newest = membership.newest(self._work, self._config.max_views // SHARED_PART)
        first = min(each.frame.frame_id for each in newest)
        work = IncrementalReconstruction(self._recipe, self._work.known)
        # Also what was set aside before: it stays with the scene that is left.
        work.retract([each.name for each in (*work.graph.keyframes, *work.aside) if each.frame.frame_id < first])
        if len(work.estimate_thoroughly(self._unless_stopping).placed) < len(newest):
            return
        shared = {each.name for each in newest}
        before = self._leave(first, shared=shared)
        event(log, logging.INFO, "next_scene", before=before, now=self._store.scene_id, shared=len(newest))
        self._work = work

    def _make_room(self) -> None:
        """Sees to it that there are not more views than configured: goes on with the newest, else gives up others."""
        if len(self._work.names) > self._config.max_views:
            self._go_on_with_newest()
        while len(self._work.names) > max(self._config.max_views, membership.NEWEST):
            name = membership.most_redundant(self._work.graph)
            event(log, logging.INFO, "given_up", frame=name)
            self._forget(name, "given up for newer views that show the same")

    def compare(self, atlas: Atlas) -> bool:
        """Links the scene with finished ones that show the same, if it is final and was not compared before.

        False where there was nothing to compare. Raises Abandoned.
        """
        names = frozenset(self._work.names)
        if not names or self._final.names != names or self._compared == names:
            return False
        state, self.state, self._compared = self.state, State.REFINING, names
        try:
            atlas.compare(self._store.scene_id, self._work.graph, self._pause)
        except Abandoned:
            self._compared = frozenset()  # only this is worth another time
            raise
        finally:
            self.state = state
        return True

    def leave_out(self, names: Sequence[str]) -> None:
        """The checkpoint no longer has these frames; the scene forgets them, too."""
        known = [name for name in names if name in self._work.names]
        self._work.retract(names)
        if known:
            self.settled, self.finished, self.state = False, None, State.GROWING
        self._show(final=self.settled and self._work.scene is not None)
        if known:
            self._output.save(self._store, self._work, final=False)

    def _forget(self, name: str, reason: str) -> None:
        self._store.forget(name, reason)
        self._work.retract([name])

    def settle(self) -> None:
        """Makes the scene afresh from all keyframes and refines it. Raises Abandoned when something comes."""
        self.state = State.REFINING
        self._judge()
        self._settle_judged()

    def _judge(self) -> None:
        """Weighs all evidence; what shows other places begins others, or becomes places of its own that wait."""
        more = True
        while more:
            fitted = set(self._work.names)
            with self._work.fallback_budget(self._config.fallback_s):
                try:
                    finishing.judge(self._work, self._forget, self._pause)
                finally:
                    self._keep_fallbacks()
            more = self._lost(fitted)
        for keyframes in membership.apart(self._work, self._pause):
            names = [keyframe.name for keyframe in keyframes]
            scene = self._store.part(names, present=True)
            self._output.parted(scene, names)
            event(log, logging.INFO, "parted", scene=self._store.scene_id, part=scene, keyframes=len(names))
            self._work.retract(names)

    def _keep_fallbacks(self) -> None:
        """Writes into the checkpoint which fallbacks gained nothing, where there are others than before."""
        if self._work.known.memory.fruitless != self._fallbacks:
            self._fallbacks = self._work.known.memory.fruitless
            self._output.save_fallbacks(self._store, self._work)

    def _settle_judged(self) -> None:
        refined = Shown()
        for refined in finishing.refine(self._work, self._recipe, self._pause):
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
            self._output.tell(snapshot, places.State.HERE, sorted(self._store.names))
        self.state = State.WAITING if not shown else State.LOST if self._strangers() else State.IDLE
        give_back_memory()

    def _pause(self) -> None:
        """Raises Abandoned if the daemon stops, or something has come."""
        self._pause_until(-math.inf)

    def _unless_stopping(self) -> None:
        """Raises Abandoned if the daemon stops: what may be shown soon is not abandoned for what comes next."""
        self._pause_until(math.inf)

    def _strangers(self) -> list[Keyframe]:
        return membership.strangers(self._work, self._unless_stopping)

    def _show(self, final: bool = False) -> Snapshot:
        self._work.estimate_soon(self._unless_stopping)
        snapshot = self._work.snapshot(self._store.dropped, final)
        measured = self._output.publish(snapshot, self._work)
        self.finished, self._shown = Finished(measured, self._work.graph.keyframes) if final else None, snapshot
        return snapshot
