"""Colours that depend on the direction: the basis of their coefficients, and these when the world is turned."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_CONSTANT = 0.28209479177387814  # the first term
_DIRECTIONS = 64  # of the fit; a band of degree 3 needs 7


def compute_sh_terms(x: Any, y: Any, z: Any, bases: int) -> list[Any]:
    """The first `bases` real spherical harmonics of unit vectors, in the order and with the signs of 3DGS; at most 16.

    The vectors' coordinates are arrays of NumPy or of torch, and so are the terms, of the same shape.
    """
    found = [0.0 * x + _CONSTANT]
    if bases > 1:
        found += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if bases > 4:
        found += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if bases > 9:
        found += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return found


def compute_sh_basis(directions: Array, bases: int) -> Array:
    """(M, B) `compute_sh_terms` of unit vectors (M, 3)."""
    x, y, z = directions.T
    return np.stack(compute_sh_terms(x, y, z, bases), 1)


def rotate_sh(sh: npt.NDArray[np.float32], rotation: Array) -> npt.NDArray[np.float32]:
    """(N, B, 3) the coefficients of the same colours after the world was turned by `rotation` (3, 3).

    What was seen along d is seen along rotation @ d. A rotation mixes the coefficients of one degree only, so each
    degree's matrix is found from a few directions, exactly but for rounding. B must be 1, 4, 9 or 16.
    """
    bases = sh.shape[1]
    if bases not in (1, 4, 9, 16):
        raise ValueError(f"sh must be (N, B, 3) with B = 1, 4, 9 or 16, got {sh.shape}")
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = compute_sh_basis(directions @ rotation, bases), compute_sh_basis(directions, bases)
    result = sh.copy()
    for degree in range(1, round(bases**0.5)):
        band = slice(degree**2, (degree + 1) ** 2)
        matrix = np.linalg.lstsq(after[:, band], before[:, band], rcond=None)[0]
        result[:, band] = np.einsum("ab,nbc->nac", matrix, sh[:, band])
    return result


def make_flat_sh(colours: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(N, 1, 3) coefficients of colours (N, 3) in [0, 1] that are the same from all directions."""
    return ((colours - 0.5) / _CONSTANT)[:, None].astype(np.float32)


def compute_mean_colours(sh: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(N, 3) the colours in [0, 1] of coefficients (N, B, 3), without what depends on the direction."""
    return np.clip(0.5 + _CONSTANT * sh[:, 0], 0.0, 1.0).astype(np.float32)
