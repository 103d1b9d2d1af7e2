"""Rotation matrices and unit quaternions (wxyz) in NumPy, for formats that are written without torch."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def quats_from_matrices(matrices: npt.ArrayLike) -> Array:
    """(..., 3, 3) rotations as (..., 4) unit quaternions with w >= 0.

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric 4x4 matrix (Bar-Itzhack 2000): no
    branches, accurate at every angle, and a matrix with rounding errors gives the nearest rotation.
    """
    m = np.asarray(matrices, np.float64)
    k = np.empty((*m.shape[:-2], 4, 4))
    k[..., 0, 0] = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    skew = (m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1])
    for i in range(3):
        k[..., 0, i + 1] = k[..., i + 1, 0] = skew[i]
        for j in range(3):
            k[..., i + 1, j + 1] = m[..., i, j] + m[..., j, i]
        k[..., i + 1, i + 1] -= k[..., 0, 0]
    quats = np.linalg.eigh(k)[1][..., -1]
    return np.where(quats[..., :1] < 0, -quats, quats)


def matrices_from_quats(quats: npt.ArrayLike) -> Array:
    """(..., 4) quaternions of any length as (..., 3, 3) rotations."""
    q = np.asarray(quats, np.float64)
    with np.errstate(all="ignore"):  # one whose length is zero or infinite is no rotation: it becomes NaN
        length = np.linalg.norm(q, axis=-1, keepdims=True)
        w, x, y, z = np.moveaxis(q / np.where(np.isfinite(length), length, np.nan), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
