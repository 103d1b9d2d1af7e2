"""How odometry says that a camera has moved from one frame to the next: wheels, an IMU, both together."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.given_pose import LARGEST_M, rigid_problem
from splatnode.capture.process.printable import LONGEST_NAME, is_printable

Matrix = npt.NDArray[np.float64]

_STILL = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Motion:
    """The motions since the chain began, added up, so that frames between two that are looked at may be missing.

    The camera looks along z, x is right, y down. What the steps are unsure adds up by squares: between two frames of a
    chain it is the root of the difference. Raises ValueError where it is no rigid motion, or a number is out of bounds.
    """

    chain: str  # motions of one chain belong together: printable, such as the name of its first frame
    T_start_current: Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)] = _STILL  # metres
    sigma_m: float = 0.0  # root of the sum of the squares of the steps' standard deviations, in each direction, metres
    sigma_deg: float = 0.0  # likewise of the turns about each axis, degrees

    def __post_init__(self) -> None:
        if not self.chain or not is_printable(self.chain, LONGEST_NAME):
            raise ValueError(f"the chain of a motion must have a printable name, got {self.chain[:40]!a}")
        if not (0 <= self.sigma_m <= LARGEST_M and 0 <= self.sigma_deg <= 1e6):
            raise ValueError(
                f"the sigmas of a motion must be 0 or more, up to {LARGEST_M:g} m and 1e6 degrees; "
                f"got {self.sigma_m:g} m and {self.sigma_deg:g} degrees"
            )
        if problem := rigid_problem(self.T_start_current):
            raise ValueError(f"a motion must be {problem}")

    @property
    def matrix(self) -> Matrix:
        """T_start_current (4, 4)."""
        return np.array(self.T_start_current, np.float64).reshape(4, 4)

    def append_step(self, T_previous_current: npt.NDArray[np.floating], sigma_m: float, sigma_deg: float) -> Motion:
        """Returns the motion with one more step: T_previous_current (4, 4), metres, and that step's sigmas.

        Raises ValueError where the step is no rigid motion, or a sigma is not above 0.
        """
        step = np.asarray(T_previous_current, np.float64)
        if step.shape != (4, 4) or (problem := rigid_problem(tuple(step.ravel().tolist()))):
            what = f"(4, 4), got {step.shape}" if step.shape != (4, 4) else problem
            raise ValueError(f"T_previous_current must be {what}")
        if not (0 < sigma_m <= LARGEST_M and 0 < sigma_deg <= 180):
            raise ValueError(
                f"the sigmas of a step must be above 0, up to {LARGEST_M:g} m and 180 degrees; "
                f"got {sigma_m:g} m and {sigma_deg:g} degrees"
            )
        whole = self.matrix @ step
        left, _, right = np.linalg.svd(whole[:3, :3])  # what is not quite a rotation would grow step by step
        whole[:3, :3] = left @ right
        sigmas = math.hypot(self.sigma_m, sigma_m), math.hypot(self.sigma_deg, sigma_deg)
        return replace(self, T_start_current=tuple(whole.ravel().tolist()), sigma_m=sigmas[0], sigma_deg=sigmas[1])
