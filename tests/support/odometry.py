"""Poses as odometry gives them: they drift, and their orientations are noisy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


def drifting(
    Ts: Sequence[Array], rng: np.random.Generator, drift: float = 0.02, noise_deg: float = 2.0, whole: bool = False
) -> list[Array]:
    """T_world_camera (4, 4) each, the first where it is; every step is off by `drift` of its length, by chance (rms).

    `whole`: the errors of the steps are enlarged until the last pose is off by `drift` of the whole way.
    Orientations have independent errors about each axis.
    """
    steps = np.diff([T[:3, 3] for T in Ts], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    errors = np.cumsum(rng.normal(0.0, drift / np.sqrt(3.0), (len(steps), 3)) * lengths[:, None], axis=0)
    if whole:
        errors *= drift * lengths.sum() / np.linalg.norm(errors[-1])
    found = []
    for T, error in zip(Ts, [np.zeros(3), *errors], strict=True):
        given = T.copy()
        given[:3, 3] += error
        given[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(np.radians(rng.normal(0.0, noise_deg, 3))).as_matrix()
        found.append(given)
    return found
