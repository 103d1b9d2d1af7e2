"""Where up is in the world of a result, by an IMU."""

from __future__ import annotations

import math
from dataclasses import dataclass

_UNIT = 1e-3  # by which the length of a direction may differ from 1


@dataclass(frozen=True)
class Up:
    """The direction against gravity. Raises ValueError where it is none."""

    direction: tuple[float, float, float]  # of length 1, in the world
    sigma_deg: float  # standard deviation in each direction
    source: str  # in words

    def __post_init__(self) -> None:
        if not abs(math.hypot(*self.direction) - 1.0) <= _UNIT or not 0 < self.sigma_deg <= 180:
            raise ValueError(f"up must be a direction of length 1 with a sigma in degrees, got {self}")
