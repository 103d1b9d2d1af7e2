"""Finishes the scenes of places that the camera has left, oldest first, from their checkpoints.

First every place is judged with all its evidence, and compared with those that were judged before it: that tells where
the robot is. Then their scenes are made, which takes longer.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from splatnode.capture.process.logs import event
from splatnode.capture.process.system import raise_shortage
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon import submap, submap_index
from splatnode.recon.daemon.atlas.loop_closure import LoopDetector
from splatnode.recon.daemon.checkpoint import checkpoint, records
from splatnode.recon.daemon.checkpoint.records import CheckpointError
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.output import Output
from splatnode.recon.daemon.work_meter import Work, WorkMeter
from splatnode.recon.incremental import IncrementalReconstruction, Pause
from splatnode.recon.modelling import SceneWithVerdict

log = logging.getLogger(__name__)

AGAIN_S = 300.0  # after a place could not be finished

_Step = Callable[[Store, checkpoint.RestoredReconstruction, Pause], bool]


class InactiveSubmaps:
    def __init__(
        self,
        here: Store,
        config: ReconstructionConfig,
        output: Output,
        atlas: LoopDetector,
        fallback_s: float = math.inf,
        meter: WorkMeter | None = None,
    ) -> None:
        """`here` is the checkpoint which has left/ in it, `config` how scenes are made.

        Fallbacks take at most `fallback_s` seconds of each step with a place.
        """
        self._here, self._config, self._output, self._atlas = here, config, output, atlas
        self._fallback_s, self._meter = fallback_s, meter or WorkMeter()
        self._work: IncrementalReconstruction | None = None  # that is being finished
        self._not_before_s: dict[Path, float] = {}  # monotonic, for those that could not be finished
        self._retract_after_s = -math.inf  # monotonic: a keyframe could not be taken out before

    @property
    def num_unfinished(self) -> int:
        """Places that were left and are not finished."""
        return len(records.list_left_folders(self._here.directory))

    def exclude_seconds(self, seconds: float) -> None:
        """Excludes these seconds, which were spent on other work, from the report."""
        if self._work is not None:
            self._work.clock.leave_out(seconds)

    def verify_next(self, pause: Pause) -> bool:
        """Judges the oldest place that is not judged yet with all its evidence, and compares it with the others.

        Its scene stays a draft, in a result folder, unless there is none to be made. False where there is none to be
        judged now. What places that were left are to lose is taken out of them first. What `pause` raises ends the
        work; it is begun again another time, as after a failure.
        """
        self._remove_keyframes()
        return self._process_first(
            [each for each in self._pending_folders if not self._atlas.has_scene(each.name)],
            self._verify,
            pause,
            Work.JUDGE,
        )

    def finalize_next(self, pause: Pause) -> bool:
        """Makes the scene of the oldest place that is judged, as good as it gets, and writes its result.

        False where there is none to be made now; `pause` as for `verify_next`.
        """
        return self._process_first(
            [each for each in self._pending_folders if self._atlas.has_scene(each.name)],
            self._finalize,
            pause,
            Work.FINISH,
        )

    @property
    def _pending_folders(self) -> list[Path]:
        """The folders of the places that are not finished, the oldest first; not those that failed a moment ago."""
        now = time.monotonic()
        return [
            each for each in records.list_left_folders(self._here.directory) if self._not_before_s.get(each, 0.0) <= now
        ]

    @property
    def num_unjudged(self) -> int:
        """Places that were left and are not judged."""
        return sum(not self._atlas.has_scene(each.name) for each in records.list_left_folders(self._here.directory))

    def _process_first(self, folders: Sequence[Path], step: _Step, pause: Pause, work: Work) -> bool:
        """Takes the step with the first of the places; False where there is none, or the disk did not take it."""
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
                    done = step(store, found, pause)
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
        """Takes out of the places that were left what they are to lose; their scenes are not final then."""
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
        folder = records.reopen(self._here.directory, scene)
        if folder is not None:
            self._atlas.remove_scene(scene)
            records.remove_rebuild_requests(folder, "codes")
            self._not_before_s.pop(folder, None)
            try:
                with contextlib.closing(Store(folder)) as store:
                    store.forget(name, "retracted")
            except CheckpointError as error:
                raise_shortage(error)
                self._output.complain(f"{name} cannot be taken out of {scene}: {error}")
        self._here.confirm_removal(scene, name)

    def _verify(self, store: Store, found: checkpoint.RestoredReconstruction, pause: Pause) -> bool:
        """Whether the place is judged now, and its result written."""
        work = found.work
        if (
            found.final and not found.new and not self._split_off(store, work, pause)
        ):  # as it was when the place was left
            self._output.mark_finished(store.scene_id)
        else:
            event(log, logging.INFO, "judging", scene=store.scene_id)
            self._verify_keyframes(store, found, pause)
            self._output.save_fallbacks(store, work)
            if not work.estimate_soon(pause).publishable:
                return self._finalize(store, found, pause)
            work.update(pause)
            snapshot = work.snapshot(store.frames_dropped, final=False)
            if not self._output.export(snapshot, work, store, submap_index.SubmapState.LEFT, work.names):
                return False
            self._output.save(store, work, final=False)
        work.release_scene()  # the checkpoint has it, and comparing takes memory, too
        give_back_memory()
        self._atlas.add_scene(store, work.graph, self._atlas.detect_loops(store.scene_id, work.graph, pause))
        return True

    def _verify_keyframes(self, store: Store, found: checkpoint.RestoredReconstruction, pause: Pause) -> None:
        """All evidence on all keyframes; those that do not belong to the place are forgotten."""
        work = found.work

        def forget(name: str, reason: str) -> None:
            store.forget(name, reason)
            work.remove_keyframes([name])

        for keyframe in submap.screen_keyframes(work, found.new, forget):  # that came shortly before the place was left
            work.add_keyframe(keyframe, pause)
        submap.verify_keyframes(work, forget, pause)
        if self._split_off(store, work, pause):
            work.estimate_thoroughly(pause)
        for keyframe in work.keyframes_deferred:
            forget(keyframe.name, "it does not fit the scene")

    def _split_off(self, store: Store, work: IncrementalReconstruction, pause: Pause) -> bool:
        """Whether some of the keyframes showed other places, and are places of their own now, which wait here."""
        parts = submap.find_separate_groups(work, pause)
        for keyframes in parts:
            names = [keyframe.name for keyframe in keyframes]
            scene = store.split_off(names)
            self._output.add_split_submap(scene, names)
            event(log, logging.INFO, "parted", scene=store.scene_id, part=scene, keyframes=len(names))
            work.remove_keyframes(names)
        return bool(parts)

    def _finalize(self, store: Store, found: checkpoint.RestoredReconstruction, pause: Pause) -> bool:
        """Whether the scene of a place that is judged is final now, and its result written."""
        work = found.work
        if not found.final:
            event(log, logging.INFO, "finishing", scene=store.scene_id)
            work.release_scene()  # it is made anew
            work.show(_refine_to_end(work, self._config, pause))
            work.estimate_soon(pause)
            snapshot = work.snapshot(store.frames_dropped, final=True)
            if not self._output.export(snapshot, work, store, submap_index.SubmapState.FINISHED, work.names):
                return False
            self._output.save(store, work, final=True)
        if work.scene is None:  # one that is refused is of no use later
            self._atlas.remove_scene(store.scene_id)
            records.remove_left_checkpoint(store.directory)
        else:
            store.remove_scene_files()
            store.finalize()
        return True


def _refine_to_end(work: IncrementalReconstruction, config: ReconstructionConfig, pause: Pause) -> SceneWithVerdict:
    show = SceneWithVerdict()
    for show in submap.refine(work, config, pause):  # noqa: B007
        pass
    return show
