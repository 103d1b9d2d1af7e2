"""The snapshots and verdicts of a rival. It publishes whatever it finds: its only refusal is to find nothing."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.modelling import create_initial_scene
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.priors import Pointmap
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.scene import Scene, background
from splatnode.recon.threads import Clock

MIN_CAMERAS = 3  # a model of two cameras counts as no answer, for every method


def make_verdict(frames: Sequence[Frame], registered: Collection[str]) -> Verdict:
    """Returns the verdict where cameras of the frames named `registered` were found."""
    missing = tuple(frame.name for frame in frames if frame.name not in registered)
    sentence = f"{len(registered)} of {len(frames)} photographs were placed."
    if len(registered) < MIN_CAMERAS:
        return Verdict(Code.NO_OVERLAP, sentence, "", missing)
    return Verdict(Code.OK_PARTIAL if missing else Code.OK, sentence, "", missing, publishable=True)


def make_refusal(frames: Sequence[Frame], clock: Clock) -> Snapshot:
    """No scene, because too few cameras were found."""
    return Snapshot(
        sequence=1,
        verdict=make_verdict(frames, ()),
        cameras=(),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=0,
        seconds=clock.stage_seconds,
        final=True,
    )


def make_snapshot(frames: Sequence[Frame], scene: Scene) -> Snapshot:
    """Makes the snapshot of Gaussians and the cameras that they were fitted with."""
    return Snapshot(
        sequence=0,
        verdict=make_verdict(frames, {view.name for view in scene.views}),
        cameras=scene.cameras(),
        gaussians=scene.arrays(),
        images={},
        dropped=(),
        iterations=scene.iterations,
        served_by=scene.served_by,
    )


def number_snapshots(
    snapshots: Iterable[Snapshot], clock: Clock, served_by: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Snapshot]:
    """The snapshots that an optimisation gives, numbered and timed as "optimise", and the last one again as final.

    `served_by` names what took the place of networks that the publication has.
    """
    last = None
    for sequence, snapshot in enumerate(snapshots, 1):
        clock.lap("optimise")
        last = replace(
            snapshot, sequence=sequence, seconds=clock.stage_seconds, served_by={**snapshot.served_by, **served_by}
        )
        yield last
        clock.lap("wait")
    assert last is not None  # an optimisation gives its end
    yield replace(last, sequence=last.sequence + 1, final=True)


# A depth for every pixel of a photograph, where a rival's publication has a monocular network.
#
# What serves is splatnode's own multi-view depth, its gaps filled from their surroundings, and the focal length that
# was estimated with it. Unlike a network's, these depths are right up to one scale that all views share: that helps a
# rival.

_SERVED_BY = {"depth": "multi-view depth"}


@dataclass(frozen=True, eq=False)
class FrameWithDepth:
    """A photograph with its depth. The pose of its camera is not given."""

    name: str
    frame_id: int
    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB at modelled size
    depth: npt.NDArray[np.float32]  # (h, w) z, everywhere
    K: npt.NDArray[np.float64]  # (3, 3)
    mask: npt.NDArray[np.bool_] | None = None  # (h, w) False: not used; None: all is


def optimize_with_depth(
    frames: Sequence[Frame], seed: int, learnt: Callable[[tuple[FrameWithDepth, ...], Clock], Iterable[Snapshot]]
) -> Iterator[Snapshot]:
    """The snapshots that `learnt` makes of the frames with their depth; one refusal where fewer than three have one.

    The clock is for what `learnt` does before its first snapshot.
    """
    clock = Clock()
    known = estimate_frame_depths(frames, seed)
    clock.lap("points")
    if len(known) < MIN_CAMERAS:
        yield make_refusal(frames, clock)
    else:
        yield from number_snapshots(learnt(known, clock), clock, _SERVED_BY)


def estimate_frame_depths(frames: Sequence[Frame], seed: int) -> tuple[FrameWithDepth, ...]:
    """The frames whose depth is known, in their order; none where splatnode itself refuses the frames."""
    config = ReconstructionConfig(seed=seed)
    estimate, _ = estimate_frames(frames, config, Clock())
    begun = create_initial_scene(estimate, config)
    if begun is None:
        return ()
    views = sorted(begun.views, key=lambda view: view.frame_id)
    masked = {frame.name for frame in frames if frame.mask is not None}  # what views see through a rival is not told
    return tuple(
        FrameWithDepth(
            view.name,
            view.frame_id,
            view.image,
            _fill_depth(view.pointmap, view.image),
            view.K.double().numpy(),
            view.mask if view.name in masked else None,
        )
        for view in views
        if view.pointmap is not None
    )


def _fill_depth(pointmap: Pointmap, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    settings = background.DepthCompletionConfig()
    known = pointmap.apply_mask(pointmap.confidence >= settings.min_confidence)
    return np.where(known.depth > 0, known.depth, background.smooth_depth(known, image, settings)).astype(np.float32)
