"""Stereo pairs: photographs of a second camera, to the right of the first, of which both pictures are rectified."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame, reduced
from splatnode.capture.lenses.undistort import undistorted
from splatnode.capture.right_image import Baseline, grey, partners

Grey = npt.NDArray[np.uint8]  # (H, W)

_LONGEST_SIDE = 1280  # pixels that are compared at least, where a photograph has them


@dataclass(frozen=True, eq=False)
class Pair:
    """What both cameras saw at once, without the distortion that was given, of one size."""

    photograph: str
    left: Grey
    right: Grey
    baseline: Baseline | None = None  # that came with it; None: as it is configured for all


def pairs_of(frames: Sequence[Frame | DroppedFrame], rights: Iterable[Frame | DroppedFrame]) -> tuple[Pair, ...]:
    """The pairs of frames and right photographs of the same name, whatever their suffixes.

    Raises ValueError where none has a partner, or a partner is of another size.
    """
    lefts = {each.name: each for each in frames if isinstance(each, Frame)}
    seen = {each.name: each for each in rights if isinstance(each, Frame)}
    return tuple(_pair(lefts[left], seen[right]) for left, right in partners(list(lefts), list(seen)).items())


def pair_with(frame: Frame) -> Pair | None:
    """The frame and the right image that came with it; None where none did. Raises ValueError for a folded lens."""
    straight = undistorted(frame)
    if straight.right is None:
        return None
    right = straight.right
    return Pair(frame.name, _compared(straight.image), _compared(right.image), right.baseline)


def rights_in(path: Path, frames: Sequence[Frame | DroppedFrame]) -> Iterator[Frame | DroppedFrame]:
    """The photographs in the folder that are partners of the frames. Raises FileNotFoundError, ValueError."""
    names = partners([each.name for each in frames], folder.names_in(path)).values()
    return folder.stream(folder.Config(folder=path, names=tuple(names)))


def _pair(left: Frame, right: Frame) -> Pair:
    """A right camera has the lens of the left one: that is what rectifying means."""
    if (right.width, right.height) != (left.width, left.height):
        raise ValueError(
            f"both photographs of a pair must have one size: {left.name} has {left.width} x {left.height} pixels, "
            f"its partner {right.width} x {right.height}"
        )
    partner = undistorted(replace(right, intrinsics=left.intrinsics))
    return Pair(left.name, _compared(undistorted(left).image), _compared(partner.image))


def _compared(image: npt.NDArray[np.uint8]) -> Grey:
    """The picture (H, W, 3) or (H, W) as it is compared with its partner."""
    return grey(reduced(image, _LONGEST_SIDE))
