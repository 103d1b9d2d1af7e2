"""Standard deviations of the cameras' poses, in whatever world frame they are given.

Positions are only known up to a similarity, and errors are measured after the best similarity. So is the covariance
here (an S-transformation: Baarda, 1973): it does not depend on which camera the bundle adjustment fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle
from splatnode.recon.registration.cross_product import cross_matrix

Array = npt.NDArray[np.float64]

_ROUNDING = 1e-9  # relative error of a variance: a negative one within it is 0, as that of two cameras' distance is
_MIN_SPREAD = 1e-12  # of the centres, in the problem's unit of length, in place of 0
_MIN_SINGULAR = 1e-9  # of the largest singular value: what is smaller is no direction of its own


def sigmas(variances: Array) -> Array:
    """The square roots of `variances`; infinite where one is negative or not finite, which says that nothing is known.

    An infinite sigma fails every limit of the verdict; NaN would pass them.
    """
    known = np.isfinite(variances) & (variances >= 0.0)
    return np.where(known, np.sqrt(np.where(known, variances, 0.0)), np.inf)


def camera_sigmas(
    problem: bundle.Problem, covariance: bundle.Covariance, registered: Sequence[int]
) -> tuple[Array, Array]:
    """Standard deviations (C,) of the orientations, degrees, and of the centres, relative to their spread.

    In the order of `registered`; each is of the error's three components together. All are infinite where poses or
    covariance are not finite, single ones where their variance is negative beyond rounding.
    """
    errors = _errors(problem, covariance, registered)
    if errors is None:
        return np.full(len(registered), np.inf), np.full(len(registered), np.inf)
    rotation_sigmas, centre_sigmas = (sigmas(_variances(by, errors.joint)) for by in (errors.turns, errors.moves))
    return np.degrees(rotation_sigmas), centre_sigmas / errors.spread


def centre_covariances(problem: bundle.Problem, covariance: bundle.Covariance, registered: Sequence[int]) -> Array:
    """(C, 3, 3) covariances of the centres after the best similarity, in the frame and unit of length of `problem`.

    In the order of `registered`; NaN where poses or covariance are not finite. Each trace is the variance whose root
    `camera_sigmas` gives over the spread.
    """
    errors = _errors(problem, covariance, registered)
    if errors is None:
        return np.full((len(registered), 3, 3), np.nan)
    own = errors.moves.reshape(len(registered), 3, -1)
    return own @ errors.joint @ own.transpose(0, 2, 1)


@dataclass(frozen=True, eq=False)
class _Errors:
    """The errors of C poses after the best similarity, by their parts."""

    joint: Array  # (6 C, 6 C) covariance of the poses' parameters
    turns: Array  # (3 C, 6 C) derivatives of the orientations in the world
    moves: Array  # (3 C, 6 C) derivatives of the centres
    spread: float  # of the centres


def _errors(problem: bundle.Problem, covariance: bundle.Covariance, registered: Sequence[int]) -> _Errors | None:
    """None where poses or covariance are not finite."""
    members = list(registered)
    rows = (6 * np.array(members)[:, None] + np.arange(6)).ravel()
    joint = covariance.joint[np.ix_(rows, rows)]
    rotations, translations = problem.rotations[members], problem.translations[members]
    count = len(members)
    if not all(np.isfinite(values).all() for values in (joint, rotations, translations)):
        return None
    turns, moves = differentiate_by_pose(rotations, translations)
    centres = np.stack([-R.T @ t for R, t in zip(rotations, translations, strict=True)])
    centred = centres - centres.mean(0)
    spread = max(float(np.sqrt((centred**2).sum(1).mean())), _MIN_SPREAD)
    # The similarity may rotate all cameras alike, and translate, rotate and scale all centres.
    translated = np.tile(np.eye(3), (count, 1))
    rotated = np.concatenate([cross_matrix(centre[None])[0] for centre in centred])
    turns = _make_null_projection(translated) @ turns
    moves = _make_null_projection(np.column_stack([translated, rotated / spread, centred.ravel() / spread])) @ moves
    return _Errors(joint, turns, moves, spread)


def differentiate_by_pose(rotations: Array, translations: Array) -> tuple[Array, Array]:
    """Derivatives (3 C, 6 C) of the orientations and centres in the world by the poses' parameters."""
    count = len(rotations)
    turns, moves = np.zeros((3 * count, 6 * count)), np.zeros((3 * count, 6 * count))
    for index, (rotation, translation) in enumerate(zip(rotations, translations, strict=True)):
        to_world = rotation.T
        own = slice(3 * index, 3 * index + 3)
        turns[own, 6 * index : 6 * index + 3] = to_world
        # The centre is -R^T t.
        moves[own, 6 * index : 6 * index + 3] = -to_world @ cross_matrix(translation[None])[0]
        moves[own, 6 * index + 3 : 6 * index + 6] = -to_world
    return turns, moves


def _variances(by: Array, joint: Array) -> Array:
    """(C,) the variance of three components together: sums of the diagonal of `by @ joint @ by.T`."""
    variances, magnitudes = (
        np.diag(left @ middle @ left.T).reshape(-1, 3).sum(1) for left, middle in ((by, joint), (abs(by), abs(joint)))
    )
    return np.where(variances < -_ROUNDING * magnitudes, variances, variances.clip(0.0))


def _make_null_projection(directions: Array) -> Array:
    """The projection that takes out what the columns of `directions` span."""
    u, s, _ = np.linalg.svd(directions, full_matrices=False)
    basis = u[:, s > _MIN_SINGULAR * s.max()]
    return np.eye(len(directions)) - basis @ basis.T
