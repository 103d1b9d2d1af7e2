"""Where a Gaussian comes from, in one number, and which Gaussians two photographs have seen.

Its `source_frame` is the frame_id of the keyframe whose pixels seeded it, where another keyframe confirms their depth;
`filled(frame_id)` where none does; and SHELL for the far shell, which no frame's pixels seeded.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

SHELL = -1

Source = TypeVar("Source")


def encode_unconfirmed(frame_id: int) -> int:
    """The source frame of Gaussians that this frame's pixels seeded at a depth that no other frame confirms."""
    return -2 - frame_id


def decode_frame_id(source_frame: Source) -> Source:
    """The frame_id (N,) of the keyframe that seeded each Gaussian, confirmed or not; SHELL for the far shell.

    Arrays and tensors alike.
    """
    return abs(source_frame + 1) - 1  # pyright: ignore


def find_confirmed(source_frame: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
    """(N,) which Gaussians began at a depth that two photographs confirm."""
    return source_frame >= 0
