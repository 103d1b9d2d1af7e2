"""Linear least squares that single wrong equations do not spoil."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_ROUNDS, _HUBER = 10, 2.0  # of reweighting; in standard deviations


def solve_robust(factors: Array, values: Array, sigmas: Array, priors: Array) -> Array:
    """(K,) the unknowns for which `factors` (N, K) times them are `values` (N,), by Huber's loss.

    `sigmas` (N,) are of the equations, `priors` (K,) of the unknowns around 0.
    """
    result, weights = np.zeros(len(priors)), np.ones(len(values))
    for _ in range(_ROUNDS):
        weighted = factors * (weights / sigmas**2)[:, None]
        result = np.linalg.solve(factors.T @ weighted + np.diag(priors**-2), weighted.T @ values)
        misfit = np.abs(factors @ result - values) / sigmas
        weights = np.minimum(1.0, _HUBER / np.maximum(misfit, 1e-9))
    return result
