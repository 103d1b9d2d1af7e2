"""Rotations of many things at once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def cross_matrices(vectors: Array) -> Array:
    """(N, 3, 3): the matrices that take the cross product with each of `vectors` (N, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(-1, 3, 3)


def rotations(vectors: Array) -> Array:
    """(N, 3, 3) of rotation vectors (N, 3) in radians, by the formula of Rodrigues."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    cross = cross_matrices(vectors)
    return np.eye(3) + np.sinc(angles / np.pi) * cross + 0.5 * np.sinc(angles / (2 * np.pi)) ** 2 * cross @ cross
