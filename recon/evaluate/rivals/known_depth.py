"""A depth for every pixel of a photograph, where a rival's publication has a monocular network.

What serves is splatnode's own multi-view depth, its gaps filled from their surroundings, and the focal length that was
estimated with it. Unlike a network's, these depths are right up to one scale that all views share: that helps a rival.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame
from splatnode.recon.clock import Clock
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.evaluate.rivals import outcome
from splatnode.recon.modelling import create_initial_scene
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import completion

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
    if len(known) < outcome.MIN_CAMERAS:
        yield outcome.make_refusal(frames, clock)
    else:
        yield from outcome.number_snapshots(learnt(known, clock), clock, _SERVED_BY)


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
    settings = completion.DepthCompletionConfig()
    known = pointmap.apply_mask(pointmap.confidence >= settings.min_confidence)
    return np.where(known.depth > 0, known.depth, completion.smooth_depth(known, image, settings)).astype(np.float32)
