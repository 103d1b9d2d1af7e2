"""Where a scene lies in the world of given poses: errors that add up along the way are told from those that do not.

Odometry is right where it begins, and drifts: the errors of two poses have in common what had grown until the earlier
one. A tracker's, an arm's or a satellite receiver's errors are each pose's own. What poses have of both is estimated by
restricted maximum likelihood (Patterson and Thompson 1971), and the scene is placed by generalised least squares: on
the first poses where errors add up, on the mean of all where they do not.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.spatial.transform import Rotation

from splatnode.recon.geometry import Similarity, cross_matrix

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.int64]

_MOST_POSES = 150  # that are looked at, evenly along the way: covariances have six rows for each
# Times what was told, for each kind of error; 0: it has none of that kind
_FACTORS = (0.0, *(2.0**power for power in range(-7, 5)))
_WIDTH = math.log(8.0)  # standard deviation of the logarithm of such a factor, before anything is known
# The logarithm of how much likelier than what was told it is that there is none of a kind, before anything is known
_NO_OWN, _NO_STEPS = -2.0, 2.0
_ROUNDS = 5
_LEAST_POSES = 3  # that tell one kind of error from the other
_MOST_SIGMAS = 4.5  # standard deviations in three dimensions, 99.99 %: their size is estimated from the same poses
_PARTED = 30.0  # times the poses' spread, and radians: standard deviation of an error of which nothing is known


@dataclass(frozen=True, eq=False)
class PoseNoise:
    """Standard deviations of the errors of C poses along the way: radians about each axis, metres in each direction."""

    own: Array  # (C, 2) of each pose by itself, and of the scene's camera, as far as they were told
    steps: Array  # (C, 2) of the step that leads to it, as far as it was told; the first counts for nothing
    least: Array  # (2,) of each pose by itself, at least

    def choose(self, kept: Mask | Index) -> PoseNoise:
        """Returns that of some of the poses; their steps have the errors of all that are between."""
        grown = np.cumsum(np.where(np.arange(len(self.steps))[:, None] > 0, self.steps, 0.0) ** 2, axis=0)[kept]
        steps = np.sqrt(np.diff(grown, axis=0, prepend=grown[:1]))
        return PoseNoise(self.own[kept], steps, self.least)


@dataclass(frozen=True)
class NoiseFactors:
    """Times what was told: each pose's own errors, and those that add up from step to step."""

    own_turn: float = 1.0
    step_turn: float = 1.0
    own_shift: float = 1.0
    step_shift: float = 1.0


@dataclass(frozen=True, eq=False)
class PosePlacement:
    """How poses place a scene whose unit is known."""

    factors: NoiseFactors
    fits: Mask  # (C,) the poses that the others do not contradict; of those not looked at, as it was before
    begun: Similarity
    scene: Array  # (K, 4, 4) cameras of the poses that count
    given: Array  # (K, 4, 4) metres
    covariance: Array  # (6 K, 6 K) of their errors: all turns, radians in the world, then all shifts, metres

    def place(self, scale: float) -> Similarity:
        """The similarity from the scene to the world of the poses, with `scale` metres a unit."""
        factor = cho_factor(self.covariance, lower=True)
        pivot = self.scene[0, :3, 3]
        rotation, shift = self.begun.rotation, self.begun(pivot)
        by = self.begun
        for _ in range(_ROUNDS):
            by = Similarity(scale, rotation, shift - scale * rotation @ pivot)
            design = _make_design(by, self.scene)[:, :6]
            weighted = cho_solve(factor, design)
            values = np.linalg.solve(design.T @ weighted, weighted.T @ _measure_errors(by, self.scene, self.given))
            rotation = Rotation.from_rotvec(values[:3]).as_matrix() @ rotation
            shift = shift + values[3:6]
        return Similarity(scale, rotation, shift - scale * rotation @ pivot)


def fit_placement(scene: Array, given: Array, begun: Similarity, kept: Mask, noise: PoseNoise) -> PosePlacement:
    """Fits what poses `given` (C, 4, 4), in the order of the way, have of both kinds of errors.

    `begun` carries the cameras `scene` (C, 4, 4) about to the poses; `kept` (C,) are those that are believed at first,
    at least one. Poses that the others contradict are left out then, and those that these confirm are taken in again.
    """
    looked = _thin_out(len(scene))
    scene, given, noise = scene[looked], given[looked], noise.choose(looked)
    believed = kept[looked] if kept[looked].any() else np.ones(len(looked), bool)
    factors = NoiseFactors()
    for _ in range(_ROUNDS if believed.sum() >= _LEAST_POSES else 0):
        factors = _estimate_factors(scene[believed], given[believed], begun, noise.choose(believed))
        fits = _find_fitting(scene, given, begun, believed, noise, factors)
        if fits.sum() < max(_LEAST_POSES, len(fits) / 2) or (fits == believed).all():
            break
        believed = fits
    fitting = kept.copy()
    fitting[looked] = believed
    covariance = _make_covariance(given[believed], noise.choose(believed), factors)
    return PosePlacement(factors, fitting, begun, scene[believed], given[believed], covariance)


def part_steps(noise: PoseNoise, parted: Mask, spread: float) -> PoseNoise:
    """Returns it where the steps `parted` (C,), to the pose of that place, tell nothing: what follows floats freely."""
    steps = np.where(parted[:, None], [_PARTED, _PARTED * spread], noise.steps)
    return replace(noise, steps=steps)


def _thin_out(count: int) -> Index:
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_POSES)).round().astype(np.int64))


def _measure_errors(by: Similarity, scene: Array, given: Array) -> Array:
    """(6 C,) the errors of the poses in their world: all turns, radians, then all shifts, metres."""
    turns = Rotation.from_matrix(given[:, :3, :3] @ np.swapaxes(by.rotation @ scene[:, :3, :3], 1, 2)).as_rotvec()
    return np.concatenate([turns.ravel(), (given[:, :3, 3] - by(scene[:, :3, 3])).ravel()])


def _make_design(by: Similarity, scene: Array) -> Array:
    """(6 C, 7) what a turn about the first camera, a shift and a share of the scale add to the poses expected."""
    arms = by(scene[:, :3, 3]) - by(scene[0, :3, 3])
    design = np.zeros((6 * len(scene), 7))
    design[: 3 * len(scene), :3] = np.tile(np.eye(3), (len(scene), 1))
    design[3 * len(scene) :, :3] = -cross_matrix(arms).reshape(-1, 3)
    design[3 * len(scene) :, 3:6] = np.tile(np.eye(3), (len(scene), 1))
    design[3 * len(scene) :, 6] = arms.ravel()
    return design


# The covariance of the errors. A turn's error that adds up moves all that comes after it, by the way from there.


@dataclass(frozen=True, eq=False)
class _Covariances:
    """The covariances of turns, and of the shifts that they make, for factors that are known."""

    turns: Array  # (3 C, 3 C)
    both: Array  # (3 C, 3 C) of shifts with turns
    by_turns: Array  # (3 C, 3 C) of the shifts that turns make


def _make_turn_covariances(given: Array, noise: PoseNoise, factors: NoiseFactors) -> _Covariances:
    count = len(given)
    lever = np.zeros((count, 3, count, 3))
    for i in range(count):
        lever[i, :, :i] = -cross_matrix(given[i, :3, 3] - given[:i, :3, 3]).transpose(1, 0, 2)
    sigma = np.repeat(factors.step_turn * np.where(np.arange(count) > 0, noise.steps[:, 0], 0.0), 3)
    moving = lever.reshape(3 * count, 3 * count) * sigma
    adding = np.kron(np.tril(np.ones((count, count))), np.eye(3)) * sigma
    own = np.kron(np.diag(_own_variances(noise, factors.own_turn, 0)), np.eye(3))
    return _Covariances(adding @ adding.T + own, moving @ adding.T, moving @ moving.T)


def _own_variances(noise: PoseNoise, factor: float, kind: int) -> Array:
    """(C,) of each pose's own errors."""
    return noise.least[kind] ** 2 + (factor * noise.own[:, kind]) ** 2


def _sum_variances(noise: PoseNoise, kind: int) -> Array:
    """(C, C) covariance of what adds up from step to step, as it was told."""
    grown = np.cumsum(np.where(np.arange(len(noise.steps)) > 0, noise.steps[:, kind], 0.0) ** 2)
    return np.minimum(grown[:, None], grown[None, :])


def _make_covariance(given: Array, noise: PoseNoise, factors: NoiseFactors) -> Array:
    """(6 C, 6 C) of all turns, then all shifts."""
    parts = _make_turn_covariances(given, noise, factors)
    own = np.diag(_own_variances(noise, factors.own_shift, 1))
    shifts = np.kron(own + factors.step_shift**2 * _sum_variances(noise, 1), np.eye(3))
    return np.block([[parts.turns, parts.both.T], [parts.both, parts.by_turns + shifts]])


# How large both kinds of errors are.


def _estimate_factors(scene: Array, given: Array, by: Similarity, noise: PoseNoise) -> NoiseFactors:
    """The factors that are likeliest: those of turns first, then of shifts beside what the turns tell of these."""
    count = len(scene)
    errors, design = _measure_errors(by, scene, given), _make_design(by, scene)
    adding, ones = _sum_variances(noise, 0), np.ones((count, 1))

    def score_turns(own: float, step: float) -> float:
        covariance = np.diag(_own_variances(noise, own, 0)) + step**2 * adding
        return _compute_likelihood(covariance, ones, errors[: 3 * count].reshape(count, 3))

    own_turn, step_turn = _find_likeliest(score_turns)
    parts = _make_turn_covariances(given, noise, NoiseFactors(own_turn, step_turn))
    regression = np.linalg.solve(parts.turns, parts.both.T).T  # of the shifts on the turns
    left = parts.by_turns - regression @ parts.both.T
    shifts = (errors[3 * count :] - regression @ errors[: 3 * count])[:, None]
    shift_design, adding = design[3 * count :] - regression @ design[: 3 * count], _sum_variances(noise, 1)

    def score_shifts(own: float, step: float) -> float:
        covariance = np.diag(_own_variances(noise, own, 1)) + step**2 * adding
        return _compute_likelihood(left + np.kron(covariance, np.eye(3)), shift_design, shifts)

    return NoiseFactors(own_turn, step_turn, *_find_likeliest(score_shifts))


def _find_likeliest(score: Callable[[float, float], float]) -> tuple[float, float]:
    """The factors of own errors and of steps: the best of a coarse grid, and from there uphill on the whole one."""

    @cache
    def judge(own: int, step: int) -> float:
        before = _weigh_before(_FACTORS[own], _NO_OWN) + _weigh_before(_FACTORS[step], _NO_STEPS)
        return score(_FACTORS[own], _FACTORS[step]) + before

    places = range(len(_FACTORS))
    best = max(itertools.product(places[::2], places[::2]), key=lambda at: judge(*at))
    while True:
        near = [[k for k in (at - 1, at, at + 1) if k in places] for at in best]
        higher = max(itertools.product(*near), key=lambda at: judge(*at))
        if judge(*higher) <= judge(*best):
            return _FACTORS[best[0]], _FACTORS[best[1]]
        best = higher


def _weigh_before(factor: float, none: float) -> float:
    """The logarithm of how likely a factor is before anything is known, up to a constant; `none` is that of 0."""
    return none if factor == 0 else -((math.log(factor) / _WIDTH) ** 2) / 2.0


def _compute_likelihood(covariance: Array, design: Array, errors: Array) -> float:
    """The restricted log likelihood of errors (N, A), a column for each of A alike, up to a constant."""
    count = errors.shape[1]
    root = np.linalg.cholesky(covariance)
    design, errors = (solve_triangular(root, each, lower=True) for each in (design, errors))
    basis, triangle = np.linalg.qr(design)
    left = errors - basis @ (basis.T @ errors)
    logs = np.log(np.diag(root)).sum() + np.log(np.abs(np.diag(triangle))).sum()
    return -count * float(logs) - float((left**2).sum()) / 2.0


def _find_fitting(
    scene: Array, given: Array, by: Similarity, believed: Mask, noise: PoseNoise, factors: NoiseFactors
) -> Mask:
    """Which poses fit what those that are believed tell of them, each judged without itself.

    Own errors are taken to be as large as was told where they are smaller: nobody is blamed for being unsure.
    """
    count = len(scene)
    wide = replace(factors, own_turn=max(factors.own_turn, 1.0), own_shift=max(factors.own_shift, 1.0))
    spread = float(np.ptp(given[:, :3, 3], axis=0).max())
    aside = np.repeat(np.where(believed, 0.0, 1.0), 3)
    aside = np.concatenate([aside * _PARTED**2, aside * (_PARTED * spread) ** 2])
    covariance = _make_covariance(given, noise, wide) + np.diag(aside)
    factor = cho_factor(covariance, lower=True)
    errors, design = _measure_errors(by, scene, given), _make_design(by, scene)
    weighted = cho_solve(factor, design)
    projected = cho_solve(factor, np.eye(6 * count)) - weighted @ np.linalg.solve(design.T @ weighted, weighted.T)
    explained, fits = projected @ errors, np.zeros(count, bool)
    for i in range(count):
        rows = np.r_[3 * i : 3 * i + 3, 3 * (count + i) : 3 * (count + i) + 3]
        of_error = np.linalg.inv(projected[np.ix_(rows, rows)])
        off, of_error = of_error @ explained[rows], of_error - np.diag(aside[rows])
        fits[i] = all(
            off[k] @ np.linalg.solve(of_error[k, k], off[k]) < _MOST_SIGMAS**2 for k in (slice(0, 3), slice(3, 6))
        )
    return fits
