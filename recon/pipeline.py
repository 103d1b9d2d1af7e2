"""Frames in, snapshots of a growing Gaussian scene out: read this first.

`reconstruct` is the one function that the offline replay, the tests and the benchmarks call; only the frames differ.
The daemon (recon/daemon) takes the same steps of `Reconstruction`, in the order in which frames happen to come; what it
needs beyond them is in recon/daemon/reconstruction.py.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.budget import hits
from splatnode.recon.clock import Clock
from splatnode.recon.config import Config
from splatnode.recon.estimation import Judgement, Judging
from splatnode.recon.frames.keyframe import Features, Keyframe, modelled_image
from splatnode.recon.frames.screening import FrameSummary, Rejected, screen, summarise
from splatnode.recon.frames.undistort import undistorted
from splatnode.recon.matching import features
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.optimize import divergence, refinement
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.prior import Prior
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.scene import growth, warping
from splatnode.recon.scene.initialisation import initial_scene
from splatnode.recon.scene.scene import Scene
from splatnode.recon.verification.likelihood import record

log = logging.getLogger(__name__)

REMEMBERED_REJECTED = 100  # frames: what is said of them changes no more
FITS = 0.1  # of the scene's depth: a scene grows while a new estimate moves its cameras by less


def reconstruct(frames: Iterable[Frame | DroppedFrame], config: Config) -> Iterator[Snapshot]:
    """Snapshots of the scene while it grows and is refined, the last of them with `final` set.

    Every frame becomes a keyframe of the view graph. Frames from a stream are worked in one at a time: the scene grows
    by what each adds, and there is a snapshot after each. Frames in a sequence are all at hand and are worked in
    together. Either way the refinement starts afresh from an estimate of all, so that the result depends on which
    frames there were and not on how they came.
    A dropped frame is named in the snapshots that follow. A snapshot holds Gaussians only if its verdict is
    publishable.
    """
    work = Reconstruction(config)
    all_at_hand = isinstance(frames, Sequence)
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            work.drop(frame)
            continue
        work.take(frame)
        if not all_at_hand:
            work.work_in()
            yield work.snapshot()
    work.find_points()
    yield from finished(work, at_once=all_at_hand)


def finished(work: Reconstruction, *, at_once: bool) -> Iterator[Snapshot]:
    """What comes of the points that were found: the scene as it begins, if it is to be seen `at_once`, and refined."""
    work.begin()
    work.show(work.begun)
    if at_once:
        yield work.snapshot()
    for scene in work.refine(work.begun, work.config.optimize, work.deadline):
        work.show(scene)
        yield work.snapshot()
    yield work.snapshot(final=True)


def prepare(frame: Frame, config: Config, found: Features | None = None) -> Keyframe:
    """The frame without distortion, with its image at modelled size and its features, unless these are known.

    No other frame is needed. Raises ValueError where the given intrinsics cannot be used.
    """
    frame = undistorted(frame)
    found = found or features.extract(frame.image, config.matching.features)
    return Keyframe(frame, modelled_image(frame.image, config.size), found)


class Reconstruction:
    """What lives as long as the stream of frames does: keyframes, their cameras and verdict, and the scene."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.clock = Clock()
        settings = msgspec.structs.replace(config.prior.config, seed=config.seed)
        self._prior: Prior = config.prior.module.load(settings)
        self.graph = ViewGraph(config.matching, self._prior.matcher)
        self.dropped: list[DroppedFrame] = []
        self.rejected: list[Rejected] = []  # those of `dropped` that the screening left out
        self.begun: Scene | None = None  # from the last estimate of all frames, not optimised
        self.scene: Scene | None = None  # what is shown
        self._ruined: Verdict | None = None  # of the last refinement, if it was given up
        self.sequence = 0
        self._looks: dict[str, FrameSummary] = {}  # of the frames that were taken
        self._judging = Judging(config)
        self.pointmaps: dict[str, Pointmap] = {}  # by keyframe, as they were last computed

    @property
    def deadline(self) -> float | None:
        return None if self.config.budget_s is None else self.clock.started + self.config.budget_s

    @property
    def names(self) -> list[str]:
        """Of the keyframes, in their order."""
        return [keyframe.name for keyframe in self.graph.keyframes]

    def drop(self, frame: DroppedFrame) -> None:
        """Keeps in mind that there was a frame that was left out."""
        self.dropped.append(frame)

    def take(self, frame: Frame) -> None:
        """Adds a frame to the view graph unless it says nothing new. Time counts from the first one.

        A frame that turns out to be blurred beside a sharper one is left out again.
        """
        if not self._looks:
            self.clock = Clock()
        self.clock.lap("wait")
        rejected = self.screen(frame)
        for each in rejected:
            self.drop(DroppedFrame(each.name, each.reason))
        gone = {each.name for each in rejected} & set(self.names)
        if gone:
            self.retract(gone)
        self.clock.lap("poses")
        if frame.name in self._looks:
            self.add(prepare(frame, self.config))

    def screen(self, frame: Frame) -> list[Rejected]:
        """The frames that say nothing beside the others, now that there is this one too: it, or earlier ones."""
        self._looks[frame.name] = summarise(frame)
        _, rejected = screen(list(self._looks.values()), self.config.screening)
        self.rejected = [*self.rejected, *rejected][-REMEMBERED_REJECTED:]
        for each in rejected:
            del self._looks[each.name]
        return rejected

    def add(self, keyframe: Keyframe) -> None:
        """Adds a frame that was prepared elsewhere to the view graph, compared with a few others for now."""
        self._looks.setdefault(keyframe.name, summarise(keyframe.frame))
        self.graph.add(keyframe, soon=True)
        newest = len(self.graph.keyframes) - 1
        overlapping = sum(newest in pair for pair in self.graph.pairs)
        compared = newest - sum(newest in pair for pair in self.graph.pending)
        num_features = len(keyframe.features.points)
        log.info("%s: %d features, overlaps %d of %d frames tried", keyframe.name, num_features, overlapping, compared)
        self.clock.lap("poses")

    def retract(self, names: Collection[str]) -> None:
        """Forgets keyframes and what the scene has from them alone. What is shown waits for the next estimate."""
        self._looks = {name: seen for name, seen in self._looks.items() if name not in names}
        self._leave_out(names)

    def _leave_out(self, names: Collection[str]) -> None:
        if set(self.names).isdisjoint(names):
            return
        self.graph = self.graph.without(names)
        self.begun = None
        self.pointmaps = {name: pointmap for name, pointmap in self.pointmaps.items() if name not in names}
        if self.scene is not None and not {view.name for view in self.scene.views}.isdisjoint(names):
            rest = growth.without_views(self.scene, names)
            self.scene = rest if rest.views else None

    def judge(self) -> Judgement:
        """Cameras of the keyframes and the verdict on them, as soon as possible: maybe for now only."""
        self.clock.lap("wait")
        judgement = self._judging.soon(self.graph, self.rejected)
        self.clock.lap("poses")
        return judgement

    def judge_thoroughly(self, pause: Callable[[], None] = lambda: None) -> Judgement:
        """The same from all that there is to know, whatever it takes. `pause` may raise to abandon the work."""
        self.clock.lap("wait")
        judgement = self._judging.thorough(self.graph, self.rejected, pause)
        self.clock.lap("poses")
        return judgement

    def work_in(self) -> None:
        """Shows a scene of all keyframes as soon as possible: grown from the one that is shown, else begun."""
        if not self.grow():
            self.estimate()
            self.show(self.begun)
        for scene in self.refine(self.scene, self.config.preview):
            self.show(scene)

    def grow(self) -> bool:
        """Adds to the shown scene what new keyframes show; False where it has to be begun anew, or given up."""
        judged = self.judge()
        if self.scene is None or judged.registration is None or not judged.verdict.publishable:
            return False
        placed = warping.registration_in_scene_world(self.scene, judged.registration, self.graph)
        known = warping.updated_pointmaps(self.pointmaps, placed, self.graph) if placed else {}
        moved = warping.warped_scene(self.scene, self.pointmaps, known, FITS)
        if placed is None or moved is None:
            return False
        further = self._prior.further_pointmaps(self.graph, placed, known)
        self.pointmaps = known | {pointmap.name: pointmap for pointmap in further}
        self.show(growth.grow(moved, self.pointmaps, self.graph, placed, self.config.initialisation))
        self.clock.lap("points")
        return True

    def estimate(self, pause: Callable[[], None] = lambda: None) -> None:
        """Begins a scene from all keyframes, which is not shown yet; none where the verdict forbids it.

        `pause` is called several times a second; it may raise to abandon the work, and nothing has happened then.
        """
        self.find_points(pause)
        self.begin()

    def find_points(self, pause: Callable[[], None] = lambda: None) -> None:
        """Point maps of all keyframes that have a camera; none where the verdict forbids a scene. `pause` as above."""
        judged = self.judge_thoroughly(pause)
        pause()
        if judged.registration is not None and judged.verdict.publishable:
            pointmaps = self._prior.pointmaps(self.graph, judged.registration, pause)
            self.pointmaps = {pointmap.name: pointmap for pointmap in pointmaps}
            self.clock.lap("points")

    def begin(self) -> None:
        """Begins a scene from the points that were found last, which is not shown yet."""
        self._ruined = None
        judged = self.judge_thoroughly()
        registration = judged.registration
        if registration is None or not judged.verdict.publishable:
            self.begun = None
            return
        self.begun = initial_scene(
            tuple(self.pointmaps.values()),
            {keyframe.name: keyframe.image for keyframe in self.graph.keyframes},
            registration.cameras,
            self.config.initialisation,
        )
        self.clock.lap("points")

    def refine(self, scene: Scene | None, config: refinement.Config, deadline: float | None = None) -> Iterator[Scene]:
        """`scene`, if there is one, at every checkpoint of its refinement and at the end, unless that ruins it."""
        if scene is None:
            return
        self.clock.lap("wait")
        self._ruined, before = None, divergence.misfit(scene)
        most = self.config.most_gaussians
        for refined in refinement.refine(scene, config, seed=self.config.seed, deadline=deadline, max_gaussians=most):
            if refined.losses or refined.iterations in self.config.optimize.checkpoints:
                self._ruined = divergence.refusal(before, refined)
            self.clock.lap("optimise")
            if self._ruined is not None:
                return
            yield refined
            self.clock.lap("wait")

    def show(self, scene: Scene | None) -> None:
        """Makes `scene`, or as much of it as there may be, the one that snapshots show; none where it was ruined."""
        if scene is None or self._ruined is not None:
            self.scene = None
        else:
            self.scene = growth.limited(scene, self.config.most_gaussians)

    def snapshot(self, final: bool = False) -> Snapshot:
        self.sequence += 1
        judged = self.judge()
        verdict, evidence = judged.verdict, judged.evidence
        if verdict.publishable and self._ruined is not None:
            verdict = self._ruined
        scene = self.scene if verdict.publishable else None
        bound = hits(self.config, self.begun, scene, self.clock.booked) if final else ()
        snapshot = Snapshot(
            sequence=self.sequence,
            verdict=verdict,
            cameras=scene.cameras() if scene else (),
            gaussians=scene.arrays() if scene else GaussianArrays.empty(),
            images={view.name: view.image for view in scene.views} if scene else {},
            dropped=tuple(self.dropped),
            iterations=scene.iterations if scene else 0,
            seconds=self.clock.booked,
            budget=tuple(hit.record() for hit in bound),
            final=final,
            served_by=scene.served_by if scene else {},
            evidence=record(evidence) if evidence is not None else None,
        )
        log.info(
            "snapshot %d: %s, %d cameras, %d Gaussians, %d iterations, %.1f s",
            self.sequence,
            verdict.code.value,
            len(snapshot.cameras),
            len(snapshot.gaussians),
            snapshot.iterations,
            snapshot.seconds["total"],
        )
        return snapshot
