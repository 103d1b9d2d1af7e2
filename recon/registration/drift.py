"""Errors of poses that drift: what odometry adds up from step to step is off more the longer the way is.

Each step is off by itself, by a share of its length and by a turn that grows with the root of it; and all steps are off
alike, by a scale. A turn's error moves all that comes after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import cross_matrix

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Drift:
    """How fast poses drift: standard deviations."""

    share: float  # of a step's error in each direction, and of the error of all lengths alike
    degrees: float  # of the turn about each axis that has grown after a metre of way; it grows with the root of the way


NO_DRIFT = Drift(0.0, 0.0)


def compute_drift_covariance(rotations: Array, centres: Array, drift: Drift) -> Array:
    """(6 C, 6 C) covariance of the errors of C poses in the order of the way, in the cameras' axes: turns and shifts.

    `rotations` (C, 3, 3) are world to camera, `centres` (C, 3) metres. The first pose has no error. Errors are taken
    for small.
    """
    count = len(centres)
    steps = np.diff(centres, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    errors = np.zeros((6 * count, 6 * count + 1))  # of the poses in the world, by the independent parts
    for i in range(1, count):
        errors[6 * i : 6 * i + 6] = errors[6 * i - 6 : 6 * i]
        turn = slice(6 * i, 6 * i + 3)
        errors[6 * i + 3 : 6 * i + 6] -= cross_matrix(steps[i - 1 : i])[0] @ errors[turn]  # turn x step
        errors[turn, turn] += np.radians(drift.degrees) * np.sqrt(lengths[i - 1]) * np.eye(3)
        errors[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6] += drift.share * lengths[i - 1] * np.eye(3)
        errors[6 * i + 3 : 6 * i + 6, -1] += drift.share * steps[i - 1]
    # A deviation from a given pose is that pose's error in the camera's axes.
    for i in range(count):
        errors[6 * i : 6 * i + 3] = rotations[i] @ errors[6 * i : 6 * i + 3]
        errors[6 * i + 3 : 6 * i + 6] = rotations[i] @ errors[6 * i + 3 : 6 * i + 6]
    return errors @ errors.T
