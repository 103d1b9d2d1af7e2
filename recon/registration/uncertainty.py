"""How uncertain each camera is, whatever world the cameras are given in.

Positions are only known up to a similarity, and errors are measured after the best one has been undone. So is the
covariance here (an S-transformation: Baarda, 1973): it does not depend on which camera was held still.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle

Array = npt.NDArray[np.float64]


def camera_sigmas(
    problem: bundle.Problem, covariance: bundle.Covariance, registered: Sequence[int]
) -> tuple[Array, Array]:
    """Standard deviations (C,) of the orientations, degrees, and of the centres, relative to their spread.

    In the order of `registered`; lengths are those of the error's three components together.
    """
    members = list(registered)
    rows = (6 * np.array(members)[:, None] + np.arange(6)).ravel()
    joint = covariance.joint[np.ix_(rows, rows)]
    count = len(members)
    turns, moves = np.zeros((3 * count, 6 * count)), np.zeros((3 * count, 6 * count))
    for place, camera in enumerate(members):
        to_world = problem.rotations[camera].T
        own = slice(3 * place, 3 * place + 3)
        turns[own, 6 * place : 6 * place + 3] = to_world
        # The centre is -R^T t.
        moves[own, 6 * place : 6 * place + 3] = -to_world @ bundle.cross_matrix(problem.translations[camera][None])[0]
        moves[own, 6 * place + 3 : 6 * place + 6] = -to_world
    centres = np.stack([-problem.rotations[c].T @ problem.translations[c] for c in members])
    centred = centres - centres.mean(0)
    spread = max(float(np.sqrt((centred**2).sum(1).mean())), 1e-12)
    shifted = np.tile(np.eye(3), (count, 1))
    turned = np.concatenate([bundle.cross_matrix(centre[None])[0] for centre in centred])
    turns = _without(shifted) @ turns
    moves = _without(np.column_stack([shifted, turned / spread, centred.ravel() / spread])) @ moves
    sigmas = [np.sqrt(np.diag(by @ joint @ by.T).reshape(count, 3).sum(1).clip(0.0)) for by in (turns, moves)]
    return np.degrees(sigmas[0]), sigmas[1] / spread


def _without(directions: Array) -> Array:
    """The projection that takes out what the columns of `directions` span."""
    u, s, _ = np.linalg.svd(directions, full_matrices=False)
    basis = u[:, s > 1e-9 * s.max()]
    return np.eye(len(directions)) - basis @ basis.T
