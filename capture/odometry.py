"""How odometry says that a camera has moved from one frame to the next: wheels, an IMU, both together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.text import LONGEST_NAME, is_printable

# Where others say that a camera was: odometry, a tracker, a drone's log.

LEAST_SIGMA = 1e-9  # metres or degrees: below it the weights of least squares overflow
LARGEST_M = 1e6  # of a coordinate, and of its standard deviation
SIGMA_M, SIGMA_DEG = 0.01, 2.0  # standard deviations where nobody tells any
_RIGID = 1e-2  # largest difference of a rotation times its transpose from the identity
_EXACT = 1e-6  # by which the last row may differ from 0 0 0 1
_SURELY = 0.999  # of a limit: within it, whatever the order in which it is computed


@dataclass(frozen=True)
class GivenPose:
    """T_world_camera in metres, row by row, and how unsure it is; the camera looks along z, x is right, y down.

    All poses of a stream have one world. Raises ValueError where it is no rigid motion, or a number is out of bounds.
    """

    T_world_camera: Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]  # row by row, metres
    sigma_m: float = SIGMA_M  # standard deviation of the position in each direction, metres
    sigma_deg: float = SIGMA_DEG  # of the orientation about each axis, degrees

    def __post_init__(self) -> None:
        if not (LEAST_SIGMA <= self.sigma_m <= LARGEST_M and LEAST_SIGMA <= self.sigma_deg <= 180):
            raise ValueError(
                f"the sigmas of a given pose must be {LEAST_SIGMA:g} or more, up to {LARGEST_M:g} m and 180 degrees; "
                f"got {self.sigma_m:g} m and {self.sigma_deg:g} degrees"
            )
        if problem := rigid_problem(self.T_world_camera):
            raise ValueError(f"a given pose must be {problem}")

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """T_world_camera (4, 4)."""
        return np.array(self.T_world_camera, np.float64).reshape(4, 4)


def rigid_problem(numbers: Sequence[float]) -> str:
    """Returns what 16 numbers, a matrix row by row in metres, must be; empty where they are a rigid motion."""
    if len(numbers) != 16 or not all(map(math.isfinite, numbers)):
        return "a matrix of 16 finite numbers row by row"
    matrix = np.array(numbers, np.float64).reshape(4, 4)
    if np.abs(matrix).max() > LARGEST_M:
        return f"within {LARGEST_M:g} m"
    rotation = matrix[:3, :3]
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0
    if turned or np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > _EXACT:
        return "a rigid motion: a rotation, a translation, and 0 0 0 1"
    return ""


# T_base_camera as records have it: 16 numbers row by row, in metres.
MountNumbers: TypeAlias = Annotated[
    tuple[Annotated[float, msgspec.Meta(ge=-LARGEST_M, le=LARGEST_M)], ...],
    msgspec.Meta(min_length=16, max_length=16),
]


def make_rigid(T: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The rigid motion (4, 4) nearest to one whose rotation is not exact, as people and files round it."""
    left, _, right = np.linalg.svd(T[:3, :3])
    exact = np.eye(4)
    exact[:3, :3], exact[:3, 3] = left @ right, T[:3, 3]
    return exact


def are_rigid(matrices: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """(N,): of which of the (N, 4, 4), metres, `rigid_problem` has surely nothing to say; quickly, of many at once."""
    flat = matrices.reshape(-1, 16)
    within = np.all(np.isfinite(flat) & (np.abs(flat) <= LARGEST_M), axis=1)
    rotations = np.where(within[:, None, None], matrices[:, :3, :3], 0.0)
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    in_place = np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(1) <= _SURELY * _EXACT
    return within & (off <= _SURELY * _RIGID) & (np.linalg.det(rotations) > 0) & in_place


def make_given_pose(
    T_world_camera: npt.NDArray[np.floating], sigma_m: float = SIGMA_M, sigma_deg: float = SIGMA_DEG
) -> GivenPose:
    """The pose of a matrix (4, 4), metres and degrees. Raises ValueError."""
    matrix = np.asarray(T_world_camera, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"a given pose must be T_world_camera (4, 4), got {matrix.shape}")
    return GivenPose(tuple(matrix.ravel().tolist()), float(sigma_m), float(sigma_deg))


Matrix = npt.NDArray[np.float64]

# Standard deviations of a motion where nobody tells any: a share of its length, at least so many metres, and degrees.
MOTION_DRIFT, MOTION_SIGMA_M, MOTION_SIGMA_DEG = 0.02, 0.001, 2.0
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


# Where an IMU says that down is.

GRAVITY_SIGMA_DEG = 2.0  # standard deviation where nobody tells any
_SHORTEST, _LONGEST = 1e-6, 1e6


@dataclass(frozen=True)
class Gravity:
    """The direction in which things fall, in the camera's frame (x right, y down, z forward), and how unsure it is.

    Its length does not count. Raises ValueError where it is no direction.
    """

    down: tuple[float, float, float]
    sigma_deg: float = GRAVITY_SIGMA_DEG  # standard deviation in each direction, degrees

    def __post_init__(self) -> None:
        length = math.hypot(*self.down)
        if len(self.down) != 3 or not _SHORTEST <= length <= _LONGEST:
            raise ValueError(f"gravity must be a direction of three numbers, not zero; got {list(self.down)[:4]}")
        if not LEAST_SIGMA <= self.sigma_deg <= 90:
            raise ValueError(
                f"the sigma of gravity must be {LEAST_SIGMA:g} or more, up to 90 degrees, got {self.sigma_deg:g}"
            )

    @property
    def direction(self) -> npt.NDArray[np.float64]:
        """(3,) of length 1."""
        down = np.array(self.down, np.float64)
        return down / np.linalg.norm(down)
