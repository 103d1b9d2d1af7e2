"""What a stereo camera's right half saw at the moment of a frame: the source of metres that a robot carries with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.printable import sanitize_text

LONGEST_M = 100.0  # between two cameras that see one thing
SIGMA_M = 0.0003  # standard deviation of a baseline where nobody tells any


@dataclass(frozen=True)
class Baseline:
    """How far apart the two cameras of a stereo camera are. Raises ValueError for what no stereo camera has."""

    metres: float
    sigma_m: float = SIGMA_M  # standard deviation, metres

    def __post_init__(self) -> None:
        if not (math.isfinite(self.metres) and 0 < self.metres <= LONGEST_M):
            raise ValueError(f"a baseline must be above 0, up to {LONGEST_M:g} m, got {self.metres:g}")
        if not (math.isfinite(self.sigma_m) and 0 <= self.sigma_m < 0.5 * self.metres):
            raise ValueError(
                f"the sigma of a baseline must be at least 0 and less than half of it, got {self.sigma_m:g} m "
                f"for {self.metres:g} m"
            )


@dataclass(frozen=True, eq=False)
class RightImage:
    """The right picture of a rectified pair: its camera has the left one's axes and lens, and stands right of it."""

    image: npt.NDArray[np.uint8]  # (H, W) grey, of the frame's size
    baseline: Baseline

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or self.image.dtype != np.uint8:
            raise ValueError(f"a right image must be (H, W) uint8, got {self.image.shape} {self.image.dtype}")


def partners(lefts: Sequence[str], rights: Sequence[str]) -> dict[str, str]:
    """The name of the right photograph of each left one that has one: both have one name, whatever their suffixes.

    Raises ValueError where none has a partner.
    """
    right_of = {_stem(name): name for name in rights}
    found = {name: right_of[_stem(name)] for name in lefts if _stem(name) in right_of}
    if not found:
        first = sanitize_text(lefts[0] if lefts else "none", 100)
        raise ValueError(f"no right photograph has the name of a left one, such as {first}; name both of a pair alike")
    return found


def _stem(name: str) -> str:
    return name.rpartition(".")[0] or name


def grey(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(H, W) of an image (H, W, 3) RGB or (H, W), as a RightImage has it."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)
