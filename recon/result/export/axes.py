"""The same Gaussians with their axes named anew, so that they are turned little: rotations that are coded in less."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np

from splatnode.recon.result.export.quaternions import matrices_from_quats, quats_from_matrices
from splatnode.recon.result.snapshot import GaussianArrays

_SIGNED = [np.diag(signs)[list(order)] for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]
_NAMINGS = np.stack([matrix for matrix in _SIGNED if np.linalg.det(matrix) > 0])  # (24, 3, 3) turns of a cube


def minimize_rotations(gaussians: GaussianArrays) -> GaussianArrays:
    """The Gaussians, each with that order and sense of its axes for which it is turned least: by at most 62.8 degrees.

    Its quaternion has w of at least .85, and each other component within .39 of 0.
    """
    rotations = matrices_from_quats(gaussians.quats)
    naming = _NAMINGS[np.einsum("nij,kji->nk", rotations, _NAMINGS).argmax(1)]  # the largest trace
    return replace(
        gaussians,
        quats=quats_from_matrices(rotations @ naming).astype(np.float32),
        scales=np.einsum("ni,nij->nj", gaussians.scales, np.abs(naming).astype(np.float32)),
    )
