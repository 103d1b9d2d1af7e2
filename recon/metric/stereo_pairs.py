"""Stereo pairs: photographs of a second camera, to the right of the first, of which both pictures are rectified."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame, reduce_image
from splatnode.capture.lenses.undistort import undistort_frame
from splatnode.capture.right_image import Baseline, grey, partners

Grey = npt.NDArray[np.uint8]  # (H, W)

_LONGEST_SIDE = 1280  # pixels that are compared at least, where a photograph has them


@dataclass(frozen=True, eq=False)
class StereoPair:
    """A stereo pair: two grey images of one size, taken at once, without the given distortion."""

    photograph: str
    left: Grey
    right: Grey
    baseline: Baseline | None = None  # that came with it; None: as it is configured for all


def make_pairs(
    frames: Sequence[Frame | DroppedFrame], rights: Iterable[Frame | DroppedFrame]
) -> tuple[StereoPair, ...]:
    """The pairs of frames and right photographs of the same name, whatever their suffixes.

    Raises ValueError where none has a partner, or a partner is of another size.
    """
    lefts = {each.name: each for each in frames if isinstance(each, Frame)}
    seen = {each.name: each for each in rights if isinstance(each, Frame)}
    return tuple(_pair(lefts[left], seen[right]) for left, right in partners(list(lefts), list(seen)).items())


def make_own_pair(frame: Frame) -> StereoPair | None:
    """The frame and the right image that came with it; None where none did. Raises ValueError for a folded lens."""
    straight = undistort_frame(frame)
    if straight.right is None:
        return None
    right = straight.right
    return StereoPair(frame.name, _convert_to_grey(straight.image), _convert_to_grey(right.image), right.baseline)


def stream_right_images(path: Path, frames: Sequence[Frame | DroppedFrame]) -> Iterator[Frame | DroppedFrame]:
    """The photographs in the folder that are partners of the frames. Raises FileNotFoundError, ValueError."""
    names = partners([each.name for each in frames], folder.names_in(path)).values()
    return folder.stream(folder.Config(folder=path, names=tuple(names)))


def _pair(left: Frame, right: Frame) -> StereoPair:
    """A right camera has the lens of the left one: that is what rectifying means."""
    if (right.width, right.height) != (left.width, left.height):
        raise ValueError(
            f"both photographs of a pair must have one size: {left.name} has {left.width} x {left.height} pixels, "
            f"its partner {right.width} x {right.height}"
        )
    partner = undistort_frame(replace(right, intrinsics=left.intrinsics))
    return StereoPair(left.name, _convert_to_grey(undistort_frame(left).image), _convert_to_grey(partner.image))


def _convert_to_grey(image: npt.NDArray[np.uint8]) -> Grey:
    """The picture (H, W, 3) or (H, W) as it is compared with its partner."""
    return grey(reduce_image(image, _LONGEST_SIDE))
