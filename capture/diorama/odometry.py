"""What wheels and an IMU of a camera in the built-in capture would say of its way: with errors, by chance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.gravity import Gravity
from splatnode.capture.motion import Motion

Matrix = npt.NDArray[np.float64]

_LEAST_M, _LEAST_DEG = 1e-3, 0.05  # standard deviations that are told, however small the errors are
_DOWN = np.array([0.0, 0.0, -1.0])  # in the world of the built-in captures


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Error of each step from a photograph to the next, as a share of its length (root mean square)
    drift: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.02
    noise_deg: Annotated[float, msgspec.Meta(ge=0, le=90)] = (
        2.0  # of each turn about each axis, and of gravity, degrees
    )


def odometry(names: Sequence[str], Ts: Sequence[Matrix], config: Config, seed: int) -> list[tuple[Motion, Gravity]]:
    """Simulates the odometry of frames with these names, taken from T_world_camera (4, 4) each.

    The standard deviations that are told are those of the errors.
    """
    rng = np.random.default_rng([seed, 2])
    found: list[tuple[Motion, Gravity]] = []
    for index, (name, T) in enumerate(zip(names, Ts, strict=True)):
        moved = _next(found[-1][0], np.linalg.inv(Ts[index - 1]) @ T, config, rng) if index else Motion(name)
        x, y, z = (_turn(config.noise_deg, rng) @ (T[:3, :3].T @ _DOWN)).tolist()
        found.append((moved, Gravity((x, y, z), max(config.noise_deg, _LEAST_DEG))))
    return found


def _next(motion: Motion, step: Matrix, config: Config, rng: np.random.Generator) -> Motion:
    measured = step.copy()
    sigma_m = config.drift / math.sqrt(3.0) * float(np.linalg.norm(step[:3, 3]))
    measured[:3, 3] += rng.normal(0.0, sigma_m, 3)
    measured[:3, :3] = step[:3, :3] @ _turn(config.noise_deg, rng)
    return motion.append_step(measured, max(sigma_m, _LEAST_M), max(config.noise_deg, _LEAST_DEG))


def _turn(noise_deg: float, rng: np.random.Generator) -> Matrix:
    return Rotation.from_rotvec(np.radians(rng.normal(0.0, noise_deg, 3))).as_matrix()
