"""Frames in, snapshots of a Gaussian scene out: read this first.

`reconstruct` is for frames that are all at hand: the offline replay, the tests and the benchmarks call it.
`reconstruct_stream` is for frames that come one at a time, and takes the steps that the daemon takes (recon/daemon).
Either way the final scene is made afresh from all frames: it depends on which frames there were, not on how they came.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.lenses import is_resampled
from splatnode.capture.process.terminal import (
    ProgressStep,
    Tell,
    add_remaining_time,
    ignore_progress,
    notify,
    report_items,
)
from splatnode.capture.process.text import sanitize_text
from splatnode.capture.rig import form_mounted_rig
from splatnode.recon import threads
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import (
    Reconstruction,
    ReconstructionSummary,
    check_device,
    estimate_cameras,
    estimate_depth,
    load_prior,
    prepare_all,
)
from splatnode.recon.fallbacks import run_fallbacks
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.keyframes import screen_all
from splatnode.recon.matching.view_graph import ViewGraph, mask_moving_objects, match
from splatnode.recon.metric.depth_fit import describe_doubtful_units
from splatnode.recon.metric.metres import NOTHING, Evidence, apply_metric_scale, check_frame, gather_evidence
from splatnode.recon.modelling import (
    create_coarse_preview,
    create_initial_scene,
    find_budget_hits,
    limit_refinement,
    prepare_scene_for_display,
    refine_scene,
    snapshot,
)
from splatnode.recon.priors import Prior
from splatnode.recon.replay_source import IMAGES, Source
from splatnode.recon.result.levels_of_detail import remove_unconfirmed
from splatnode.recon.result.report import write_result_folder
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import Scene
from splatnode.recon.threads import Clock, RunContext

log = logging.getLogger(__name__)

DEPTH_SHARE = 0.4  # of the seconds that the cameras left of a budget: the refinement needs most of them


def reconstruct(
    frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig, tell: Tell = ignore_progress
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
    look = create_coarse_preview(estimate, config)
    clock.lap("points")
    if look is not None:
        yield snapshot(next(numbers), estimate.summary, look, config, seconds=clock.stage_seconds, dropped=dropped)
        clock.lap("wait")
    estimate = _add_depth(estimate, prior, config, clock, tell)
    conclusion, begun = estimate.summary_to_save, create_initial_scene(estimate, config)
    del estimate, look  # and with them photographs, features and matches, which are not needed any more
    yield from model_scene(conclusion, begun, dropped, config, clock, numbers, tell=tell)


def estimate_frames(
    frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig, clock: Clock
) -> tuple[Reconstruction, list[DroppedFrame]]:
    """Cameras, verdict and depth of all frames that show something new, and which frames were left out."""
    check_device(config)
    prior = load_prior(config)
    estimate, dropped = estimate_frame_cameras(frames, prior, config, clock)
    return _add_depth(estimate, prior, config, clock), dropped


def estimate_frame_cameras(
    frames: Iterable[Frame | DroppedFrame],
    prior: Prior,
    config: ReconstructionConfig,
    clock: Clock,
    tell: Tell = ignore_progress,
) -> tuple[Reconstruction, list[DroppedFrame]]:
    """Cameras and verdict of all frames that show something new, and which frames were left out."""
    kept, dropped, rejected = screen_all(frames, config.screening)
    looked_through = report_items(kept, tell, "finding points to match", len(kept), "photograph")
    keyframes, unusable = prepare_all(looked_through, config)
    deadline = clock.deadline(config.budget_s) or math.inf
    half = clock.started + (deadline - clock.started) / 2  # the least that cameras take is not bound by a budget
    run = RunContext(deadline=deadline, tell=tell)
    graph = match(keyframes, config.matching, prior.matcher, run.advance_deadline(half))
    graph = mask_moving_objects(graph, prior.matcher, RunContext(deadline=half))
    for line in _format_shared_points(graph):
        tell(line)
    estimate = estimate_cameras(graph, rejected, config, run.report("finding and checking the cameras"))
    clock.lap("poses")
    estimate = run_fallbacks(estimate, rejected, config, run.report("looking for more matches"))
    clock.lap("fallbacks")
    return estimate, dropped + unusable


def _format_shared_points(graph: ViewGraph) -> Iterator[str]:
    """A line a keyframe: with how many others it has matches that one geometry explains. None where there is one."""
    for index, name in enumerate(graph.names if len(graph.names) > 1 else ()):
        others = len(graph.partners(index))
        shared = f"shares points with {others or 'no'} other{'s' if others > 1 else ''}"
        yield f"{index + 1} of {len(graph.names)}: {sanitize_text(name)} {shared}"


def _add_depth(
    estimate: Reconstruction, prior: Prior, config: ReconstructionConfig, clock: Clock, tell: Tell = ignore_progress
) -> Reconstruction:
    """Estimates depth; a budget allots it DEPTH_SHARE of what is left, or as near to that as can be."""
    run, end = RunContext(tell=tell), clock.deadline(config.budget_s)
    if end is not None:
        run = run.advance_deadline(clock.last + DEPTH_SHARE * max(0.0, end - clock.last))
    estimate = estimate_depth(estimate, prior, run.report("estimating depth"))
    clock.lap("points")
    return estimate


def model_scene(
    conclusion: ReconstructionSummary,
    begun: Scene | None,
    dropped: list[DroppedFrame],
    config: ReconstructionConfig,
    clock: Clock,
    numbers: Iterator[int] | None = None,
    show_begun: bool = True,
    tell: Tell = ignore_progress,
) -> Iterator[Snapshot]:
    """The scene, if one was begun, refined. `numbers` are those of the snapshots."""
    numbers = numbers or itertools.count(1)
    config = limit_refinement(config, begun)
    show = prepare_scene_for_display(begun, config)
    clock.lap("points")
    if show_begun:
        yield snapshot(next(numbers), conclusion, show, config, seconds=clock.stage_seconds, dropped=dropped)
        clock.lap("wait")

    def report_step(done: int) -> None:
        tell(ProgressStep("refining the scene", done, config.optimize.steps, "step"))

    for show in refine_scene(begun, config, config.optimize, clock.deadline(config.budget_s), report_step):
        clock.lap("optimise")
        yield snapshot(next(numbers), conclusion, show, config, seconds=clock.stage_seconds, dropped=dropped)
        clock.lap("wait")
    bound = find_budget_hits(config, begun, show.scene, clock.stage_seconds, ended_early=show.verdict is not None)
    yield snapshot(
        next(numbers), conclusion, show, config, seconds=clock.stage_seconds, dropped=dropped, budget=bound, final=True
    )


def reconstruct_stream(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Iterator[Snapshot]:
    """A snapshot after each frame, while the scene grows where it stands; then those of `reconstruct` for all."""
    work = IncrementalReconstruction(config)
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            work.drop(frame)
            continue
        work.add_frame(frame)
        work.update()
        yield work.snapshot()
    yield from rebuild_from_scratch(work)


def rebuild_from_scratch(work: IncrementalReconstruction, tell: Tell = ignore_progress) -> Iterator[Snapshot]:
    """The snapshots of `reconstruct`, from its refinement on, for all frames that `work` has taken."""
    tell = add_remaining_time(tell)
    estimate = work.estimate_with_depth(RunContext(tell=tell).report("finding and checking the cameras"))
    begun = create_initial_scene(estimate, work.config)
    yield from model_scene(
        estimate.summary_to_save,
        begun,
        work.dropped,
        work.config,
        work.clock,
        work.numbers,
        show_begun=False,
        tell=tell,
    )


# Photographs that are all at hand, from what is asked for to what is written.
#
# `splatnode replay` and the Python interface call this.


@dataclass(frozen=True, eq=False)
class OfflineResult:
    """The result of an offline reconstruction, with what its report says of how it was made."""

    snapshot: Snapshot
    source: Source  # without its frames where a folder has them
    seed: int
    preset: str

    def write(self, out: Path) -> dict[str, object]:
        """Writes the result folder and returns its report.

        Raises ResultWriteError, with what was there before intact.
        """
        files = self.source.files() if self.snapshot.verdict.publishable else {}
        lie_in = self.source.photographs or (out / IMAGES if files else None)
        extra_fields: dict[str, object] = {"photographs": None if lie_in is None else _encode_path(lie_in.resolve())}
        if self.source.choice is not None:
            extra_fields["selection"] = self.source.choice.record()
        return write_result_folder(
            self.snapshot, out, seed=self.seed, preset_name=self.preset, photographs=files, extra_fields=extra_fields
        )


def _encode_path(folder: Path) -> str | None:
    """The folder's path; None where it is no text, as Linux allows, which no JSON file can hold."""
    try:
        return folder.as_posix().encode().decode()
    except UnicodeEncodeError:
        return None


def ignore_snapshot(_: Snapshot) -> None:
    """Ignores a snapshot: nobody watches."""


def reconstruct_source(
    source: Source,
    config: ReconstructionConfig,
    preset_name: str,
    without_guesses: bool = False,
    most_threads: int | None = None,
    given: Evidence = NOTHING,
    *,
    show: Callable[[Snapshot], None] = ignore_snapshot,
    tell: Tell = ignore_progress,
) -> OfflineResult:
    """The final snapshot of what `source` gives, in metres where `config` knows how.

    `given` is what is known of metres beside the photographs. `without_guesses` leaves out what no two photographs
    confirm. `show` gets every snapshot, and `tell` hears what is being done. The work takes `most_threads` threads at
    most; None: as many as the process may use.
    Raises ValueError where the intrinsics of a photograph or a number of threads cannot be used, and UnknownFrame
    where nothing can tell the frame of reference that is asked for.
    """
    tell = add_remaining_time(tell)
    if doubt := describe_doubtful_units(source.frames):
        notify(log, doubt)
    with threads.apply_thread_limit(most_threads):
        evidence = given.merge(gather_evidence(source.frames, config.metric, tell))
        known = (each for each in source.frames if isinstance(each, Frame))
        has_rig = config.registration.rig is not None or form_mounted_rig(known) is not None
        check_frame(config.metric, evidence, has_lengths=has_rig)
        snapshot = apply_metric_scale(run(source.frames, config, show, tell), config.metric, evidence)
    snapshot = _add_given_lenses(snapshot, source.frames)
    if without_guesses:
        snapshot = remove_unconfirmed(snapshot)
    kept = source if source.photographs is None else replace(source, frames=())
    return OfflineResult(snapshot, kept, config.seed, preset_name)


def _add_given_lenses(snapshot: Snapshot, frames: Iterable[Frame | DroppedFrame]) -> Snapshot:
    """The snapshot with the lens that was given for each camera, where its photograph was resampled by it."""
    given = {each.name: each.intrinsics for each in frames if isinstance(each, Frame) and is_resampled(each)}
    cameras = tuple(replace(camera, given_lens=given.get(camera.name)) for camera in snapshot.cameras)
    return replace(snapshot, cameras=cameras)


def run(
    frames: Iterable[Frame | DroppedFrame],
    config: ReconstructionConfig,
    show: Callable[[Snapshot], None] = ignore_snapshot,
    tell: Tell = ignore_progress,
) -> Snapshot:
    """The final snapshot; every one is given to `show`, and what is being done to `tell`."""
    snapshot = None
    for snapshot in reconstruct(frames, config, tell):
        show(snapshot)
    if snapshot is None:
        raise AssertionError("reconstruct always yields a last snapshot")
    return snapshot


def check_baseline(config: ReconstructionConfig, source: Source) -> None:
    """Raises ValueError before the work where a measured distance names a photograph that is not used."""
    names = [frame.name for frame in source.frames]
    missing = [name for baseline in config.metric.baselines for name in baseline[:2] if name not in names]
    if missing and source.choice is not None:
        raise ValueError(
            f"the baseline's photograph {missing[0]!r} is not among those that were chosen: {', '.join(names)}. "
            f"Measure between two of these, or use all {source.choice.what}s (--every-frame)"
        )
    if missing:
        raise ValueError(
            f"the baseline's photograph {missing[0]!r} is not among those that are used: {', '.join(names)}. "
            "Measure between two of these, or have it used, too"
        )


def set_preview_interval(config: ReconstructionConfig, every: int) -> ReconstructionConfig:
    """The same reconstruction, with a snapshot to look at `every` so many iterations."""
    looks = tuple(range(every, config.optimize.iterations, every))
    return msgspec.structs.replace(config, optimize=msgspec.structs.replace(config.optimize, looks=looks))
