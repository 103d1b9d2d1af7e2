"""Frames in, snapshots of a growing Gaussian scene out: read this first.

`reconstruct` is the one function that the daemon, the offline replay, the tests and the benchmarks call; only the
iterator of frames differs.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import msgspec

from capture.frame import DroppedFrame, Frame
from recon import optimize
from recon.config import Config
from recon.judge import judge
from recon.keyframe import Keyframe, modelled_image
from recon.priors import classical
from recon.priors.prior import Prior
from recon.registration import features
from recon.scene import Scene, begin, extend
from recon.snapshot import GaussianArrays, Snapshot
from recon.verdict import Verdict
from recon.view_graph import ViewGraph

log = logging.getLogger(__name__)


def reconstruct(frames: Iterable[Frame | DroppedFrame], config: Config) -> Iterator[Snapshot]:
    """Snapshots of the scene while it grows and is refined, the last of them with `final` set.

    Every frame becomes a keyframe of the view graph. Frames from a stream are worked in one at a time: cameras and
    points are estimated anew, what the scene has already learnt is carried over, and there is a snapshot after each.
    Frames in a sequence are all at hand and are worked in together. Either way the refinement starts afresh from the
    last estimate, so that the result depends on which frames there were and not on how they came.
    A dropped frame is named in the snapshots that follow. A snapshot holds Gaussians only if its verdict is
    publishable.
    """
    run = _Run(config)
    all_at_hand = isinstance(frames, Sequence)
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            run.dropped.append(frame)
            continue
        run.take(frame)
        if not all_at_hand:
            run.estimate()
            for _ in run.refine(config.preview):
                pass
            yield run.snapshot()
    if all_at_hand:
        run.estimate()
        yield run.snapshot()
    run.scene = run.begun
    for _ in run.refine(config.optimize):
        yield run.snapshot()
    yield run.snapshot(final=True)


@dataclass
class _Clock:
    """Seconds by stage; "wait" is for the next frame, and for whoever reads the snapshots."""

    started: float = field(default_factory=time.monotonic)
    last: float = field(default_factory=time.monotonic)
    seconds: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str) -> None:
        """Books the time since the last lap on `stage`."""
        now = time.monotonic()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now


class _Run:
    """What lives as long as the stream of frames does."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.clock = _Clock()
        self.graph = ViewGraph(config.prior.registration)
        self.prior: Prior = classical.load(msgspec.structs.replace(config.prior, seed=config.seed))
        self.dropped: list[DroppedFrame] = []
        self.verdict: Verdict = judge(self.graph, None, config.judge)
        self.begun: Scene | None = None  # from the last estimate, not optimised
        self.scene: Scene | None = None
        self.sequence = 0

    @property
    def deadline(self) -> float | None:
        return None if self.config.budget_s is None else self.clock.started + self.config.budget_s

    def take(self, frame: Frame) -> None:
        """The frame as a keyframe of the view graph. Time counts from the first one."""
        if not self.graph.keyframes:
            self.clock = _Clock()
        self.clock.lap("wait")
        found = features.extract(frame.image, self.config.prior.registration.features)
        self.graph.add(Keyframe(frame, modelled_image(frame.image, self.config.size), found))
        newest = len(self.graph.keyframes) - 1
        overlapping = sum(newest in pair for pair in self.graph.pairs)
        log.info("%s: %d features, overlaps %d of %d frames", frame.name, len(found.points), overlapping, newest)
        self.clock.lap("poses")

    def estimate(self) -> None:
        """Cameras, points and verdict for all keyframes; the scene begun, extended, or given up."""
        registration = self.prior.register(self.graph)
        self.verdict = judge(self.graph, registration, self.config.judge)
        self.clock.lap("poses")
        if not self.verdict.publishable or registration is None:
            self.begun = self.scene = None
            return
        images = {keyframe.name: keyframe.image for keyframe in self.graph.keyframes}
        config = self.config
        self.begun = begin(
            self.prior.pointmaps(self.graph, registration),
            images,
            registration.cameras,
            config.completion,
            config.density,
            config.background,
            config.max_gaussians,
        )
        grown = extend(self.scene, self.begun) if self.scene is not None else self.begun
        fits = config.max_gaussians is None or len(grown.gaussians) <= config.max_gaussians
        self.scene = grown if fits else self.begun
        self.clock.lap("points")

    def refine(self, config: optimize.Config) -> Iterator[None]:
        """Refines the scene, if there is one; stops for a look at every checkpoint and at the end."""
        if self.scene is None:
            return
        self.clock.lap("wait")
        for scene in optimize.refine(self.scene, config, seed=self.config.seed, deadline=self.deadline):
            self.scene = scene
            self.clock.lap("optimise")
            yield
            self.clock.lap("wait")

    def snapshot(self, final: bool = False) -> Snapshot:
        self.sequence += 1
        scene = self.scene
        snapshot = Snapshot(
            sequence=self.sequence,
            verdict=self.verdict,
            cameras=scene.cameras() if scene else (),
            gaussians=scene.arrays() if scene else GaussianArrays.empty(),
            images={view.name: view.image for view in scene.views} if scene else {},
            dropped=tuple(self.dropped),
            iterations=scene.iterations if scene else 0,
            seconds={**self.clock.seconds, "total": time.monotonic() - self.clock.started},
            final=final,
        )
        log.info("snapshot %d: %s, %d Gaussians", self.sequence, self.verdict.code.value, len(snapshot.gaussians))
        return snapshot
