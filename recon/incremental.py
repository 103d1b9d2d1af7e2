"""A reconstruction whose frames come one at a time: what it knows, and the steps by which it comes to know more.

All that it knows is one frozen record, which each step replaces whole: a step that is abandoned leaves what was known.
Only steps that take a RunContext compute: they pause about once a second at least, which may abandon the work.
Estimates that were made a moment ago are kept: a keyframe may be tried and taken back, and nothing is estimated twice.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import (
    Reconstruction,
    UnusableFrame,
    check_device,
    estimate_cameras,
    estimate_depth,
    extend_reconstruction,
    load_prior,
    prepare,
)
from splatnode.recon.fallbacks import make_fallback_key, run_fallbacks
from splatnode.recon.keyframes import Keyframe, Rejected, ScreeningState
from splatnode.recon.matching.view_graph import ViewGraph, mask_moving_objects, match_newest, match_pending
from splatnode.recon.metric.depth_fusion import fill_measured_depth
from splatnode.recon.modelling import (
    SceneWithVerdict,
    create_initial_scene,
    find_budget_hits,
    format_snapshot,
    prepare_scene_for_display,
    refine_scene,
    snapshot,
)
from splatnode.recon.optimize import training
from splatnode.recon.priors import Pointmap, apply_image_masks
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import Scene, growth
from splatnode.recon.threads import BACKGROUND, Clock, OutOfTime, RunContext, Timer

REMEMBERED = 8  # estimates: a keyframe that is tried with each of several others, and taken back
REMEMBERED_MASKED = 2  # estimates with things that move, whose photographs are copies without these
REMEMBERED_REFUSED = 100  # sets of keyframes of which nothing came: they need not be tried again

REMEMBERED_FRUITLESS = 200  # starts of fallbacks that gained nothing

Key = tuple[tuple[str, ...], int]  # the keyframes' names, and how many frames were rejected beside them


@dataclass(frozen=True, eq=False)
class ReconstructionCache:
    """The latest estimates, by the keyframes that they are about; what was asked for last comes last."""

    recent: tuple[tuple[Key, Reconstruction], ...] = ()
    refused: tuple[frozenset[str], ...] = ()  # sets of keyframes for which a thorough estimate forbade a scene
    proven: frozenset[str] = frozenset()  # keyframes of the last thorough estimate that was publishable
    # Starts of fallbacks that gained nothing (recon/fallbacks.py), and what the verdict then said of them
    fruitless: tuple[tuple[str, str], ...] = ()

    def find_reconstruction(self, key: Key) -> Reconstruction | None:
        """The estimate for just these keyframes, if it is remembered."""
        return dict(self.recent).get(key)

    def add_reconstruction(self, key: Key, estimate: Reconstruction) -> ReconstructionCache:
        """Returns the cache with this estimate as the latest one."""
        recent = [*((known, before) for known, before in self.recent if known != key), (key, estimate)][-REMEMBERED:]
        masked = [known for known, before in recent if any(keyframe.moving for keyframe in before.graph.keyframes)]
        gone = masked[:-REMEMBERED_MASKED]
        memory = replace(self, recent=tuple((known, before) for known, before in recent if known not in gone))
        if estimate.verdict.provisional:
            return memory
        names = frozenset(key[0])
        if estimate.verdict.publishable:
            return replace(memory, proven=names)
        refused = [known for known in self.refused if known != names]
        return replace(memory, refused=(*refused, names)[-REMEMBERED_REFUSED:])

    def add_fruitless_fallback(self, start: str, sentence: str) -> ReconstructionCache:
        """Adds a start from which fallbacks gained nothing; `sentence` is what the verdict says of them."""
        others = [each for each in self.fruitless if each[0] != start]
        return replace(self, fruitless=(*others, (start, sentence))[-REMEMBERED_FRUITLESS:])

    def find_fruitless_fallback(self, start: str) -> str | None:
        """Returns what the verdict said of fruitless fallbacks from this start; None without such."""
        return dict(self.fruitless).get(start)

    def is_rejected(self, names: Collection[str]) -> bool:
        """Whether a thorough estimate for these keyframes is known, and forbade a scene."""
        return frozenset(names) in self.refused

    def newest_publishable(self, among: Collection[str]) -> Reconstruction | None:
        """The latest estimate with cameras that may be published whose keyframes are all `among` these."""
        for (names, _), estimate in reversed(self.recent):
            if estimate.publishable and set(names) <= set(among):
                return estimate
        return None


log = logging.getLogger(__name__)

MAX_CAMERA_SHIFT = 0.1  # in median depths: where a new estimate moves a camera further, a scene begins anew
WORTH_S = 0.1  # of fallbacks that gained nothing, from which on it is worth to remember that


@dataclass(frozen=True, eq=False)
class StreamState:
    """All that a growing reconstruction knows."""

    graph: ViewGraph  # of the keyframes that belong to the scene
    beside: ViewGraph  # what is known of keyframes that were set aside, and of others
    screened: ScreeningState = field(default_factory=ScreeningState)
    memory: ReconstructionCache = field(default_factory=ReconstructionCache)
    pointmaps: Mapping[str, Pointmap] = field(default_factory=dict)  # by keyframe, as they were last computed
    begun: Scene | None = None  # from the last estimate of all frames, not refined
    show: SceneWithVerdict = field(default_factory=SceneWithVerdict)

    @property
    def key(self) -> Key:
        """Returns the key under which the reconstruction of these keyframes is cached."""
        return tuple(self.graph.names), len(self.screened.rejected)


class IncrementalReconstruction:
    """Keyframes, their cameras and verdict, and the scene that grows with them."""

    def __init__(self, config: ReconstructionConfig, known: StreamState | None = None) -> None:
        """`known` is what an earlier process knew."""
        self.config = config
        self.clock = Clock()
        self.numbers: Iterator[int] = itertools.count(1)  # of the snapshots
        self.dropped: list[DroppedFrame] = []
        self._fallback_budget_s = self._fallbacks_left_s = math.inf  # seconds
        check_device(config)
        self._prior = load_prior(config)
        empty = ViewGraph(config.matching)
        self._known = known or StreamState(empty, empty)

    @property
    def state(self) -> StreamState:
        return self._known

    @property
    def graph(self) -> ViewGraph:
        return self._known.graph

    @property
    def names(self) -> list[str]:
        """Returns the names of the keyframes that belong to the scene, in their order."""
        return self._known.graph.names

    @property
    def scene(self) -> Scene | None:
        """Returns the scene that snapshots show."""
        return self._known.show.scene

    @property
    def initial_scene(self) -> Scene | None:
        return self._known.begun

    @property
    def keyframes_deferred(self) -> list[Keyframe]:
        """Keyframes that are known and do not belong to the scene, in the order in which their frames came."""
        belonging = set(self.names)
        found = [keyframe for keyframe in self._known.beside.keyframes if keyframe.name not in belonging]
        return sorted(found, key=lambda keyframe: keyframe.frame.frame_id)

    @property
    def publishable_names(self) -> frozenset[str]:
        """The keyframes that a publishable verdict was last given on thoroughly."""
        return self._known.memory.proven

    def is_rejected(self, names: Collection[str]) -> bool:
        """Whether a thorough estimate for these keyframes, just these, is known and forbade a scene."""
        return self._known.memory.is_rejected(names)

    def drop(self, frame: DroppedFrame) -> None:
        """Keeps in mind that there was a frame that was left out."""
        self.dropped.append(frame)

    def add_frame(self, frame: Frame, run: RunContext = BACKGROUND) -> None:
        """Adds a frame to the view graph unless it says nothing new. Time counts from the first one.

        A frame that turns out to be blurred beside a sharper one is left out again, and so is one that cannot become a
        keyframe. Raises UnusableFrame where that is the first one.
        """
        if not self._known.screened.summaries:
            self.clock = Clock()
        self.clock.lap("wait")
        rejected = self.screen(frame)
        self.dropped += [DroppedFrame(each.name, each.reason) for each in rejected]
        self.remove_keyframes({each.name for each in rejected})
        self.clock.lap("poses")
        if frame.name in self._known.screened.summaries:
            self._prepare_and_add(frame, run)

    def _prepare_and_add(self, frame: Frame, run: RunContext) -> None:
        try:
            keyframe = prepare(frame, self.config)
        except UnusableFrame as error:
            if not self.graph.keyframes:
                raise
            log.warning("left out: %s", error)
            self.drop(DroppedFrame(frame.name, str(error).removeprefix(f"{frame.name}: ")))
            self.remove_keyframes({frame.name})
            return
        self.add_keyframe(keyframe, run)

    def screen(self, frame: Frame) -> list[Rejected]:
        """The frames that say nothing beside the others, now that there is this one too: it, or earlier ones."""
        screened, rejected = self._known.screened.add_frame(frame, self.config.screening)
        self._known = replace(self._known, screened=screened)
        return rejected

    def add_keyframe(self, keyframe: Keyframe, run: RunContext = BACKGROUND) -> None:
        """Adds a keyframe to the view graph, matched with a few others at first."""
        graph = self.graph.add_keyframe(keyframe)
        self._known = replace(self._known, graph=graph, screened=self._known.screened.add_known_frame(keyframe.frame))
        self._keep_matching(match_newest(graph, self._prior.matcher), run)
        newest, num_features = len(self.graph.keyframes) - 1, len(keyframe.features.points)
        sharing = len(self.graph.partners(newest))
        compared = newest - sum(newest in pair for pair in self.graph.pending)
        description = f"shares points with {sharing} of the {compared} photographs that it was compared with"
        description = description if compared else "the first photograph"
        log.info("%s: %s (%d image features)", keyframe.name, description, num_features)
        self.clock.lap("poses")

    def match_pending_pairs(self, run: RunContext = BACKGROUND) -> None:
        """Matches the pairs that are still pending. What was matched is kept if a pause raises."""
        self._keep_matching(match_pending(self.graph, self._prior.matcher), run)

    def _keep_matching(self, graphs: Iterable[ViewGraph], run: RunContext) -> None:
        for graph in graphs:
            self._known = replace(self._known, graph=graph)
            run.pause()

    def remove_keyframes(self, names: Collection[str]) -> None:
        """Forgets keyframes, and what the scene has from them alone."""
        known = self._known
        self._known = replace(
            known, screened=known.screened.remove_frames(names), beside=known.beside.remove_keyframes(names)
        )
        self._remove_from_scene(names)

    def defer_keyframes(self, names: Collection[str]) -> None:
        """Takes keyframes out of the scene as `remove_keyframes` does, and remembers them and what their pairs say."""
        self._known = replace(self._known, beside=self.graph.merge(self._known.beside))
        self._remove_from_scene(names)

    def restore_keyframes(self, names: Collection[str]) -> None:
        """The keyframes among these that were set aside belong to the scene as before."""
        others = {keyframe.name for keyframe in self.keyframes_deferred}.difference(names)
        self._known = replace(self._known, graph=self.graph.merge(self._known.beside.remove_keyframes(others)))

    def _remove_from_scene(self, names: Collection[str]) -> None:
        if set(self.names).isdisjoint(names):
            return
        known, show = self._known, self._known.show
        if show.scene is not None and not {view.name for view in show.scene.views}.isdisjoint(names):
            rest = growth.remove_views(show.scene, names)
            show = replace(show, scene=rest if rest.views else None)
        pointmaps = {name: pointmap for name, pointmap in known.pointmaps.items() if name not in names}
        self._known = replace(
            known, graph=known.graph.remove_keyframes(names), begun=None, pointmaps=pointmaps, show=show
        )

    def find_reconstruction(self) -> Reconstruction | None:
        """The estimate of just these keyframes, if it was made a moment ago."""
        return self._known.memory.find_reconstruction(self._known.key)

    def estimate_thoroughly(self, run: RunContext = BACKGROUND) -> Reconstruction:
        """Cameras and verdict from all that there is to know, whatever it takes; remembered while nothing changes."""
        estimate = self.find_reconstruction()
        if estimate is not None and not estimate.verdict.provisional:
            return estimate
        self.clock.lap("wait")
        self.match_pending_pairs(run)
        graph, rejected = (
            mask_moving_objects(self.graph, self._prior.matcher, run=run),
            self._known.screened.rejected,
        )
        estimate = estimate_cameras(graph, rejected, self.config, run)
        self.clock.lap("poses")
        estimate = self._run_fallbacks(estimate, rejected, run)
        self._remember(estimate)
        self.clock.lap("fallbacks")
        return estimate

    @contextlib.contextmanager
    def fallback_budget(self, seconds: float) -> Iterator[None]:
        """Meanwhile all fallbacks together take at most so long; what pauses take does not count."""
        self._fallback_budget_s = self._fallbacks_left_s = seconds
        try:
            yield
        finally:
            self._fallback_budget_s = self._fallbacks_left_s = math.inf

    def _run_fallbacks(self, estimate: Reconstruction, rejected: Sequence[Rejected], run: RunContext) -> Reconstruction:
        """The estimate after what else there is to try, unless that gained nothing from the same start before."""
        start, memory = make_fallback_key(estimate.graph, self.config), self._known.memory
        sentence = memory.find_fruitless_fallback(start)
        if sentence is not None:
            verdict = estimate.verdict
            return (
                replace(estimate, verdict=replace(verdict, message=verdict.message + sentence))
                if sentence
                else estimate
            )
        left_s = self._fallbacks_left_s
        if left_s <= 0:
            return estimate
        timer, found = Timer(left_s, run), estimate
        try:
            found = run_fallbacks(estimate, rejected, self.config, timer.run)
        except OutOfTime:
            log.info("fallbacks ended after %.1f s, all that there were", left_s)
            if left_s < self._fallback_budget_s:  # others had a part of it: another time there may be more
                return estimate
        finally:
            self._fallbacks_left_s -= timer.spent_s
        if found.registration is estimate.registration and (found is not estimate or timer.spent_s > WORTH_S):
            sentence = found.verdict.message.removeprefix(estimate.verdict.message)
            self._known = replace(self._known, memory=memory.add_fruitless_fallback(start, sentence))
        return found

    def estimate_quickly(self) -> Reconstruction | None:
        """Returns the cached reconstruction, or extends one to all keyframes; None without either."""
        estimate = self.find_reconstruction()
        if estimate is not None:
            return estimate
        self.clock.lap("wait")
        known = self._known.memory.newest_publishable(self.names)
        estimate = None if known is None else extend_reconstruction(known, self.graph, self.config)
        if estimate is not None:
            self._remember(estimate)
        self.clock.lap("poses")
        return estimate

    def estimate_soon(self, run: RunContext = BACKGROUND) -> Reconstruction:
        """As `estimate_quickly`, else as `estimate_thoroughly`."""
        return self.estimate_quickly() or self.estimate_thoroughly(run)

    def estimate_with_depth(self, run: RunContext = BACKGROUND) -> Reconstruction:
        """A thorough estimate, with point maps made afresh from all keyframes where a scene is allowed."""
        estimate = self.estimate_thoroughly(run)
        run.pause()
        estimate = estimate_depth(estimate, self._prior, run)
        self.clock.lap("points")
        return estimate

    def _remember(self, estimate: Reconstruction) -> None:
        self._known = replace(self._known, memory=self._known.memory.add_reconstruction(self._known.key, estimate))

    def update(self, run: RunContext = BACKGROUND) -> None:
        """Shows a scene of all keyframes as soon as possible: grown from the one that is shown, else begun."""
        if not self.grow(run):
            self.rebuild(run)
            self.show(prepare_scene_for_display(self.initial_scene, self.config))
        for show in self.refine(self.scene, self.config.preview):
            self.show(show)

    def grow(self, run: RunContext = BACKGROUND) -> bool:
        """Adds to the shown scene what new keyframes show; False where it has to be begun anew, or given up."""
        estimate, scene = self.estimate_soon(run), self.scene
        if scene is None or estimate.registration is None or not estimate.verdict.publishable:
            return False
        beside = growth.align_registration(scene, estimate.registration, estimate.graph, estimate.verdict.provisional)
        carried = growth.update_pointmaps(self._known.pointmaps, beside.registration, beside.graph) if beside else {}
        moved = beside and growth.warp_scene(beside.scene, self._known.pointmaps, carried, MAX_CAMERA_SHIFT)
        if beside is None or moved is None:
            return False
        graph, placed = beside.graph, beside.registration
        further = fill_measured_depth(self._prior.further_pointmaps(graph, placed, carried), graph, placed)
        pointmaps = carried | apply_image_masks(further, graph)
        grown = growth.grow(
            moved, pointmaps, graph, placed, self.config.scene_initialization, self.config.exposure_compensation
        )
        self._known = replace(self._known, pointmaps=pointmaps, show=prepare_scene_for_display(grown, self.config))
        self.clock.lap("points")
        return True

    def rebuild(self, run: RunContext = BACKGROUND) -> None:
        """Begins a scene from all keyframes, which is not shown yet; none where the verdict forbids it."""
        estimate = self.estimate_with_depth(run)
        begun = create_initial_scene(estimate, self.config, all_at_hand=False)
        self._known = replace(self._known, pointmaps=estimate.pointmaps or self._known.pointmaps, begun=begun)
        self.clock.lap("points")

    def refine(
        self, scene: Scene | None, steps: training.RefinementConfig, run: RunContext = BACKGROUND
    ) -> Iterator[SceneWithVerdict]:
        """`scene`, if there is one, at every checkpoint of its refinement and at the end. It is not shown yet."""
        self.clock.lap("wait")
        for show in refine_scene(scene, self.config, steps, gone_on=lambda done: run.pause()):
            self.clock.lap("optimise")
            yield show
            self.clock.lap("wait")

    def show(self, show: SceneWithVerdict) -> None:
        """Makes this what snapshots show."""
        self._known = replace(self._known, show=show)

    def release_scene(self) -> None:
        """Gives the memory of all scenes and depth maps back; the photographs, their pairs and the estimate stay."""
        self._known = replace(self._known, pointmaps={}, begun=None, show=SceneWithVerdict())

    def snapshot(self, dropped: Collection[DroppedFrame] | None = None, final: bool = False) -> Snapshot:
        """Makes a snapshot. `dropped` are the frames to name as left out; None: those that were dropped.

        Raises RuntimeError where these keyframes have no estimate: one of the steps that estimate comes before.
        """
        estimate = self.find_reconstruction()
        if estimate is None:
            raise RuntimeError("a snapshot needs an estimate of the keyframes: call estimate_soon before")
        left_out = self.dropped if dropped is None else dropped
        show, seconds, bound = self._known.show, self.clock.stage_seconds, ()
        if final and estimate.verdict.publishable:
            bound = find_budget_hits(
                self.config, self.initial_scene, show.scene, seconds, ended_early=show.verdict is not None
            )
        made = snapshot(
            next(self.numbers), estimate.summary, show, self.config,
            seconds=seconds, dropped=left_out, budget=bound, final=final,
        )  # fmt: skip
        log.info("%s", format_snapshot(made))
        return made
