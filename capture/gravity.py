"""Where an IMU says that down is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

SIGMA_DEG = 2.0  # standard deviation where nobody tells any
_SHORTEST, _LONGEST = 1e-6, 1e6


@dataclass(frozen=True)
class Gravity:
    """The direction in which things fall, in the camera's frame (x right, y down, z forward), and how unsure it is.

    Its length does not count. Raises ValueError where it is no direction.
    """

    down: tuple[float, float, float]
    sigma_deg: float = SIGMA_DEG  # standard deviation in each direction, degrees

    def __post_init__(self) -> None:
        length = math.hypot(*self.down)
        if len(self.down) != 3 or not _SHORTEST <= length <= _LONGEST:
            raise ValueError(f"gravity must be a direction of three numbers, not zero; got {list(self.down)[:4]}")
        if not 0 < self.sigma_deg <= 90:
            raise ValueError(f"the sigma of gravity must be above 0, up to 90 degrees, got {self.sigma_deg:g}")

    @property
    def direction(self) -> npt.NDArray[np.float64]:
        """(3,) of length 1."""
        down = np.array(self.down, np.float64)
        return down / np.linalg.norm(down)
