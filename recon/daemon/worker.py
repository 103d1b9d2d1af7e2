"""The thread that reconstructs: works keyframes in as they come, and makes the scene as good as it gets in between."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial

import msgspec

from splatnode.capture.process.logs import event
from splatnode.capture.process.memory_shortage import SHORT_OF_MEMORY, is_shortage
from splatnode.recon.daemon import membership
from splatnode.recon.daemon.checkpoint import checkpoint
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.config import Config
from splatnode.recon.daemon.inbox import Arrived, Inbox, LeftOut
from splatnode.recon.daemon.output import Output, Published
from splatnode.recon.daemon.status import State
from splatnode.recon.daemon.watcher import Finished
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.modelling import Shown
from splatnode.recon.result import bounds_in_words
from splatnode.recon.result.snapshot import Snapshot

log = logging.getLogger(__name__)

STEP = 10  # iterations between looks at the inbox
IDLE_S = 0.5  # between looks at whether to stop
PATIENCE_S = 3.0  # that a thorough judgement of a keyframe that does not fit may keep others waiting
MOST_ASIDE = 8  # keyframes that may still find their place
FIRST_WAIT_S, LONGEST_WAIT_S = 5.0, 300.0  # after a step for which the memory did not suffice; doubled each time
TRIED_AGAIN = f"{SHORT_OF_MEMORY}. What failed is tried again"


class _Abandoned(Exception):
    """Something more urgent has come."""


class Worker:
    def __init__(
        self,
        config: Config,
        store: Store,
        inbox: Inbox,
        publish: Callable[[Published], None],
        stopping: threading.Event,
    ) -> None:
        limit = min(config.max_gaussians, config.reconstruction.max_gaussians or config.max_gaussians)
        self._recipe = msgspec.structs.replace(config.reconstruction, max_gaussians=limit, budget_s=None)
        self._config, self._store, self._inbox = config, store, inbox
        self._output = Output(config, store, publish, self._complain)
        self._stopping = stopping
        self._work = IncrementalReconstruction(self._recipe)
        self._settled = True  # nothing can be made better before the next keyframe
        self._owed: list[Arrived] = []  # keyframes that a step that failed did not work in
        self._wait_s, self._not_before_s = FIRST_WAIT_S, -math.inf  # for memory; monotonic
        self.state = State.WAITING
        self.problem = ""
        self.keyframe_s: float | None = None
        self.finished: Finished | None = None  # while no keyframe waits
        self.moved_s = time.monotonic()  # when the work last got on

    def run(self) -> None:
        """Until the daemon stops; an export that has begun is finished. Raises MemoryError and the like."""
        found = self._restored()
        if found is not None:
            self._guarded(lambda: self._go_on(found))
        while not self._stopping.is_set():
            self.moved_s = time.monotonic()
            waiting = time.monotonic() < self._not_before_s
            events = self._inbox.get(IDLE_S if self._settled or waiting else self._config.settle_s)
            arrived = [each for each in events if isinstance(each, Arrived)]
            left_out = [each.name for each in events if isinstance(each, LeftOut)]
            if arrived:
                self._guarded(lambda arrived=arrived: self._take_in(arrived))
            elif left_out:
                self._guarded(lambda left_out=left_out: self._leave_out(left_out))
            elif not self._settled and not waiting:
                self._guarded(lambda: self._take_in([]) if self._owed else self._settle())

    def _guarded(self, step: Callable[[], None]) -> None:
        """A step that fails is told, and repeated only where it was for want of memory: what comes next may succeed."""
        try:
            step()
            if self._wait_s > FIRST_WAIT_S:
                self.problem, self._wait_s = self.problem.removeprefix(TRIED_AGAIN), FIRST_WAIT_S
        except _Abandoned:
            pass
        except Exception as error:
            log.exception("a step of the reconstruction failed")
            short = is_shortage(error)
            self.problem = TRIED_AGAIN if short else f"{type(error).__name__}: {error}"
            self._settled = not short
            if short:
                self._not_before_s = time.monotonic() + self._wait_s
                self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)

    def _restored(self) -> checkpoint.Restored | None:
        """What an earlier process knew. Raises MemoryError and the like: the next start may have memory enough."""
        try:
            return checkpoint.restore(self._store, self._recipe)
        except Exception as error:
            if is_shortage(error):
                raise
            log.exception("the checkpoint cannot be restored")
            self.problem = f"the checkpoint cannot be restored: {error}"
            return None

    def _go_on(self, found: checkpoint.Restored) -> None:
        """Goes on where an earlier process was."""
        self._work = found.work
        self._settled = found.final or not found.keyframes
        if not found.keyframes:
            return
        event(log, logging.INFO, "restored", scene=self._store.scene_id, keyframes=found.keyframes, new=len(found.new))
        if found.new or self._work.scene is None:
            self._take_in([Arrived(keyframe, time.monotonic()) for keyframe in found.new])
        else:
            self.state = State.IDLE if self._settled else State.GROWING
            self._show(final=self._settled)

    def _take_in(self, arrived: Sequence[Arrived]) -> None:
        """Keyframes that have come, shown together."""
        self.state, self.problem = State.GROWING, ""
        self._settled, self.finished = False, None
        arrived = self._owed = self._with_those_before(arrived)
        self._make_room(len(arrived))
        keyframes = self._screened([each.keyframe for each in arrived])
        strangers = self._added(keyframes)
        self._owed = []
        if not strangers or len(strangers) < len(keyframes):
            self._show_grown(arrived)
        if strangers and self._receive(strangers):
            self._show_grown(arrived)
        self.state = State.LOST if self._strangers() else State.GROWING

    def _with_those_before(self, arrived: Sequence[Arrived]) -> list[Arrived]:
        """Also those keyframes that a step that failed left out, and that nobody has removed since."""
        there = {*self._work.names, *(keyframe.name for keyframe in self._work.aside)}
        owed = [each for each in self._owed if each.keyframe.name in self._store.names - there]
        self._work.retract([each.keyframe.name for each in owed])  # they were screened, and are screened again
        return [*owed, *arrived]

    def _show_grown(self, arrived: Sequence[Arrived]) -> None:
        """The scene with the keyframes that have come to belong to it."""
        self._work.update(self._unless_stopping)
        snapshot = self._show()
        if arrived:
            self.keyframe_s = time.monotonic() - arrived[0].at_s
        event(
            log, logging.INFO, "keyframes", names=",".join(each.keyframe.name for each in arrived),
            verdict=snapshot.verdict.code.value, gaussians=len(snapshot.gaussians), seconds=self.keyframe_s or 0.0,
            bounds=bounds_in_words.of_cameras(snapshot.cameras, snapshot.scale),
        )  # fmt: skip
        self._output.save(self._work, final=False)

    def _screened(self, keyframes: Sequence[Keyframe]) -> list[Keyframe]:
        """Those of the keyframes that show something new, and sharply; what does not is given up."""
        kept = []
        for keyframe in keyframes:
            gone = {each.name: each.reason for each in self._work.screen(keyframe.frame)}
            kept = [each for each in (*kept, keyframe) if each.name not in gone]
            for name, reason in gone.items():
                event(log, logging.INFO, "left_out", frame=name, reason=reason)
                self._forget(name, reason)
        return kept

    def _added(self, keyframes: list[Keyframe]) -> set[str]:
        """Adds keyframes to the view graph; names those that do not fit at once, which are set aside."""
        try:
            return membership.add(self._work, keyframes, self._unless_stopping)
        except _Abandoned:
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
        """Whether the scene changes by keyframes that did not fit at once. Raises _Abandoned.

        They are judged thoroughly with all others, as long as what waits can wait; if they are too many, in any case.
        If that does not help them, another place begins with them.
        """
        lost = len(self._strangers()) >= self._config.lost_after
        pause = partial(self._pause, math.inf if lost else time.monotonic() + PATIENCE_S)
        aside = [keyframe.name for keyframe in self._work.aside]
        joined = membership.connected(self._work, pause) and (
            membership.join(self._work, aside, pause) or (not lost and membership.join(self._work, newest, pause))
        )
        for keyframe in self._work.aside[: -max(MOST_ASIDE, self._config.lost_after)]:
            self._forget(keyframe.name, "it does not fit the scene")
        return self._lost(newest) or joined

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
        """The scene that was is exported as it is, and another begins with the frames that do not belong to it."""
        self.state = State.LOST
        self._output.export(self._show())
        before = self._store.scene_id
        self._store.begin_place(strangers[0].frame.frame_id)
        event(log, logging.WARNING, "another_place", before=before, now=self._store.scene_id)
        self._work = IncrementalReconstruction(self._recipe)
        for keyframe in strangers:
            self._work.add(keyframe, self._unless_stopping)

    def _make_room(self, coming: int) -> None:
        """Gives up views that can be spared, so that there are not more than configured."""
        for _ in range(len(self._work.names) + coming - self._config.max_views):
            if len(self._work.names) <= membership.NEWEST:
                return
            name = membership.most_redundant(self._work.graph)
            event(log, logging.INFO, "given_up", frame=name)
            self._forget(name, "given up for newer views that show the same")

    def _leave_out(self, names: Sequence[str]) -> None:
        """The checkpoint no longer has these frames; the scene forgets them, too."""
        known = [name for name in names if name in self._work.names]
        self._work.retract(names)
        if known:
            self._settled, self.finished, self.state = False, None, State.GROWING
        self._show(final=self._settled and self._work.scene is not None)
        if known:
            self._output.save(self._work, final=False)

    def _forget(self, name: str, reason: str) -> None:
        self._store.forget(name, reason)
        self._work.retract([name])

    def _settle(self) -> None:
        """Makes the scene afresh from all keyframes and refines it. Raises _Abandoned when something comes."""
        self.state = State.REFINING
        config = self._recipe.optimize
        steps = msgspec.structs.replace(config, checkpoints=tuple(range(STEP, config.iterations, STEP)))
        fitted = set(self._work.names)
        membership.prove(self._work, self._pause)
        for keyframe in membership.contradicting(self._work, self._pause):
            self._forget(keyframe.name, "it contradicts the scene")
        self._lost(fitted)
        self._work.rebuild(self._pause)
        refined = Shown()
        for refined in self._work.refine(self._work.begun, steps):
            self._pause()
            if refined.scene is not None and refined.scene.iterations in config.checkpoints:
                self._work.show(refined)
                self._show()
        self._settled = True
        self._work.show(refined)
        shown = self._work.scene is not None
        snapshot = self._show(final=shown)
        if shown:
            exported = self._output.export(snapshot)
            self._output.save(self._work, final=exported)  # what is kept as final is not exported after a restart
        self.state = State.WAITING if not shown else State.LOST if self._strangers() else State.IDLE

    def _pause(self, until_s: float = 0.0) -> None:
        """Raises _Abandoned if the daemon stops, and from `until_s` (monotonic) on if something has come."""
        self.moved_s = time.monotonic()
        if self._stopping.is_set() or (len(self._inbox) and self.moved_s > until_s):
            raise _Abandoned

    def _unless_stopping(self) -> None:
        """Raises _Abandoned if the daemon stops: what may be shown soon is not abandoned for what comes next."""
        self._pause(math.inf)

    def _strangers(self) -> list[Keyframe]:
        return membership.strangers(self._work, self._unless_stopping)

    def _show(self, final: bool = False) -> Snapshot:
        self._work.estimate_soon(self._unless_stopping)
        snapshot = self._work.snapshot(self._store.dropped, final)
        self._output.publish(snapshot)
        self.finished = Finished(snapshot, self._work.graph.keyframes) if final else None
        return snapshot

    def _complain(self, problem: str) -> None:
        self.problem = problem
        log.error("%s", problem)
