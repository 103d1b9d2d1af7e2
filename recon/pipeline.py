"""Frames in, snapshots of a Gaussian scene out: read this first.

`reconstruct` is for frames that are all at hand: the offline replay, the tests and the benchmarks call it.
`reconstruct_stream` is for frames that come one at a time, and takes the steps that the daemon takes (recon/daemon).
Either way the final scene is made afresh from all frames: it depends on which frames there were, not on how they came.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.process.printable import printable
from splatnode.capture.process.progress import Step, Tell, counted, told_to_nobody
from splatnode.recon.budget import hits
from splatnode.recon.clock import Clock
from splatnode.recon.config import Config
from splatnode.recon.estimation import Conclusion, Estimate, estimate_cameras, estimate_depth
from splatnode.recon.frames.screening import screen_all
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.ladder.ladder import climbed
from splatnode.recon.matching.match import match
from splatnode.recon.matching.moving import without_moving
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.modelling import begin_scene, looked_at_first, refined, shown, snapshot
from splatnode.recon.preparation import check_device, load_prior, prepare_all
from splatnode.recon.priors.prior import Prior
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene.scene import Scene

DEPTH_SHARE = 0.4  # of the seconds that the cameras left of a budget: the refinement needs most of them


def reconstruct(
    frames: Iterable[Frame | DroppedFrame], config: Config, tell: Tell = told_to_nobody
) -> Iterator[Snapshot]:
    """Snapshots of the scene at a first look, as it begins and while it is refined, the last of them with `final` set.

    A snapshot names the frames that were left out, and holds Gaussians only if its verdict is publishable. `tell` hears
    what is being done, and what each frame shares with others.
    Raises ValueError where the intrinsics of a frame cannot be used.
    """
    clock, numbers = Clock(), itertools.count(1)
    check_device(config)
    prior = load_prior(config)
    estimate, dropped = estimate_frame_cameras(frames, prior, config, clock, tell)
    look = looked_at_first(estimate, config)
    clock.lap("points")
    if look is not None:
        yield snapshot(next(numbers), estimate.conclusion, look, config, seconds=clock.booked, dropped=dropped)
        clock.lap("wait")
    estimate = _with_depth(estimate, prior, config, clock, tell)
    conclusion, begun = estimate.conclusion_to_save, begin_scene(estimate, config)
    del estimate, look  # and with them photographs, features and matches, which are not needed any more
    yield from model(conclusion, begun, dropped, config, clock, numbers, tell=tell)


def estimate_frames(
    frames: Iterable[Frame | DroppedFrame], config: Config, clock: Clock
) -> tuple[Estimate, list[DroppedFrame]]:
    """Cameras, verdict and depth of all frames that show something new, and which frames were left out."""
    check_device(config)
    prior = load_prior(config)
    estimate, dropped = estimate_frame_cameras(frames, prior, config, clock)
    return _with_depth(estimate, prior, config, clock), dropped


def estimate_frame_cameras(
    frames: Iterable[Frame | DroppedFrame], prior: Prior, config: Config, clock: Clock, tell: Tell = told_to_nobody
) -> tuple[Estimate, list[DroppedFrame]]:
    """Cameras and verdict of all frames that show something new, and which frames were left out."""
    kept, dropped, rejected = screen_all(frames, config.screening)
    looked_through = counted(kept, tell, "finding points to match", len(kept), "photograph")
    keyframes, unusable = prepare_all(looked_through, config)
    deadline = clock.deadline(config.budget_s) or math.inf
    half = clock.started + (deadline - clock.started) / 2  # the least that cameras take is not bound by a budget
    graph = match(keyframes, config.matching, prior.matcher, until=half, tell=tell)
    graph = without_moving(graph, prior.matcher, half)
    for line in _shared(graph):
        tell(line)
    estimate = estimate_cameras(graph, rejected, config, _doing("finding and checking the cameras", tell))
    clock.lap("poses")
    estimate = climbed(estimate, rejected, config, _doing("looking for more matches", tell), until=deadline)
    clock.lap("ladder")
    return estimate, dropped + unusable


def _shared(graph: ViewGraph) -> Iterator[str]:
    """A line a keyframe: with how many others it has matches that one geometry explains. None where there is one."""
    for index, name in enumerate(graph.names if len(graph.names) > 1 else ()):
        others = len(graph.partners(index))
        shared = f"shares points with {others or 'no'} other{'s' if others > 1 else ''}"
        yield f"{index + 1} of {len(graph.names)}: {printable(name)} {shared}"


def _doing(what: str, tell: Tell) -> Callable[[], None]:
    """A `pause` that tells that this is being done, and never raises."""
    return lambda: tell(Step(what))


def _with_depth(
    estimate: Estimate, prior: Prior, config: Config, clock: Clock, tell: Tell = told_to_nobody
) -> Estimate:
    """With depth; with a budget, it is found in DEPTH_SHARE of what is left, or as near to that as can be."""
    until = clock.deadline(config.budget_s)
    if until is not None:
        until = clock.last + DEPTH_SHARE * max(0.0, until - clock.last)
    estimate = estimate_depth(estimate, prior, _doing("estimating depth", tell), until=until)
    clock.lap("points")
    return estimate


def model(
    conclusion: Conclusion,
    begun: Scene | None,
    dropped: list[DroppedFrame],
    config: Config,
    clock: Clock,
    numbers: Iterator[int] | None = None,
    show_begun: bool = True,
    tell: Tell = told_to_nobody,
) -> Iterator[Snapshot]:
    """The scene, if one was begun, refined. `numbers` are those of the snapshots."""
    numbers = numbers or itertools.count(1)
    show = shown(begun, config)
    clock.lap("points")
    if show_begun:
        yield snapshot(next(numbers), conclusion, show, config, seconds=clock.booked, dropped=dropped)
        clock.lap("wait")

    def gone_on(done: int) -> None:
        tell(Step("refining the scene", done, config.optimize.steps, "step"))

    for show in refined(begun, config, config.optimize, clock.deadline(config.budget_s), gone_on):
        clock.lap("optimise")
        yield snapshot(next(numbers), conclusion, show, config, seconds=clock.booked, dropped=dropped)
        clock.lap("wait")
    bound = hits(config, begun, show.scene, clock.booked, ended_early=show.verdict is not None)
    yield snapshot(
        next(numbers), conclusion, show, config, seconds=clock.booked, dropped=dropped, budget=bound, final=True
    )


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
    yield from made_anew(work)


def made_anew(work: IncrementalReconstruction, tell: Tell = told_to_nobody) -> Iterator[Snapshot]:
    """The snapshots of `reconstruct`, from its refinement on, for all frames that `work` has taken."""
    estimate = work.estimate_with_depth(_doing("finding and checking the cameras", tell))
    begun = begin_scene(estimate, work.config)
    yield from model(
        estimate.conclusion_to_save,
        begun,
        work.dropped,
        work.config,
        work.clock,
        work.numbers,
        show_begun=False,
        tell=tell,
    )
