"""Where others say that a camera was: odometry, a tracker, a drone's log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

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
        if not (0 < self.sigma_m <= LARGEST_M and 0 < self.sigma_deg <= 180):
            raise ValueError(
                f"the sigmas of a given pose must be above 0 and finite, up to {LARGEST_M:g} m and 180 degrees; "
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
