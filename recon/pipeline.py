"""Frames in, snapshots of a Gaussian scene out: read this first.

`reconstruct` is for frames that are all at hand: the offline replay, the tests and the benchmarks call it.
`reconstruct_stream` is for frames that come one at a time, and takes the steps that the daemon takes (recon/daemon).
Either way the final scene is made afresh from all frames: it depends on which frames there were, not on how they came.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.budget import hits
from splatnode.recon.clock import Clock
from splatnode.recon.config import Config
from splatnode.recon.estimation import Estimate, estimate_cameras, estimate_depth
from splatnode.recon.frames.screening import screen_all
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.ladder.ladder import climbed
from splatnode.recon.matching.match import match
from splatnode.recon.modelling import begin_scene, refined, shown, snapshot
from splatnode.recon.preparation import load_device, load_prior, prepare
from splatnode.recon.result.snapshot import Snapshot


def reconstruct(frames: Iterable[Frame | DroppedFrame], config: Config) -> Iterator[Snapshot]:
    """Snapshots of the scene as it begins and while it is refined, the last of them with `final` set.

    A snapshot names the frames that were left out, and holds Gaussians only if its verdict is publishable.
    Raises ValueError where the intrinsics of a frame cannot be used.
    """
    clock = Clock()
    estimate, dropped = estimate_frames(frames, config, clock)
    yield from model(estimate, dropped, config, clock)


def estimate_frames(
    frames: Iterable[Frame | DroppedFrame], config: Config, clock: Clock
) -> tuple[Estimate, list[DroppedFrame]]:
    """Cameras, verdict and depth of all frames that show something new, and which frames were left out."""
    load_device(config)
    prior = load_prior(config)
    kept, dropped, rejected = screen_all(frames, config.screening)
    keyframes = [prepare(frame, config) for frame in kept]
    graph = match(keyframes, config.matching, prior.matcher)
    estimate = estimate_cameras(graph, rejected, config)
    clock.lap("poses")
    estimate = climbed(estimate, rejected, config)
    clock.lap("ladder")
    estimate = estimate_depth(estimate, prior)
    clock.lap("points")
    return estimate, dropped


def model(
    estimate: Estimate,
    dropped: list[DroppedFrame],
    config: Config,
    clock: Clock,
    numbers: Iterator[int] | None = None,
    show_begun: bool = True,
) -> Iterator[Snapshot]:
    """The scene that begins from the estimate, refined. `numbers` are those of the snapshots."""
    numbers = numbers or itertools.count(1)
    begun = begin_scene(estimate, config)
    show = shown(begun, config)
    clock.lap("points")
    if show_begun:
        yield snapshot(next(numbers), estimate, show, seconds=clock.booked, dropped=dropped)
        clock.lap("wait")
    for show in refined(begun, config, config.optimize, clock.deadline(config.budget_s)):
        clock.lap("optimise")
        yield snapshot(next(numbers), estimate, show, seconds=clock.booked, dropped=dropped)
        clock.lap("wait")
    bound = hits(config, begun, show.scene, clock.booked)
    yield snapshot(next(numbers), estimate, show, seconds=clock.booked, dropped=dropped, budget=bound, final=True)


def reconstruct_stream(frames: Iterable[Frame | DroppedFrame], config: Config) -> Iterator[Snapshot]:
    """A snapshot after each frame, while the scene grows where it stands; then those of `reconstruct` for all."""
    work = IncrementalReconstruction(config)
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            work.drop(frame)
            continue
        work.take(frame)
        work.update()
        yield work.snapshot()
    estimate = work.estimate_with_depth()
    yield from model(estimate, work.dropped, config, work.clock, work.numbers, show_begun=False)
