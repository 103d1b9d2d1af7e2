"""What a robot knows of its own way: motions from image to image, gravity, and poses whose errors may add up.

Motions, of wheels or an IMU, give the unit. Each of them is compared with what the photographs say of the same two
cameras, in the frame of the first of them. So an error of one motion is in no other, and turns that add up along the
way bend nothing. A motion that does not fit is named and left out. Neither the photographs' cameras nor the scene are
changed by them otherwise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, pairwise
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import least_squares, minimize_scalar
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Gravity, Motion
from splatnode.recon.geometry import Similarity, align_cameras, angles_deg, compute_rms_radius, cross_matrix
from splatnode.recon.metric.measurement import TWO_SIDED_95, Measurement, MetricView
from splatnode.recon.result.verdict import Up

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.int64]

_FARTHEST = 3.76  # standard deviations in three dimensions: what one has within 3 in one dimension, 99.7 %
_LEAST_DEG = 1.0  # standard deviation of a turn between two cameras of the scene: their own, and how it is mounted
_LEAST_FITTING = 0.6  # of the motions
_LEAST_KNOWN = 0.3  # standard deviation of the log of the unit: what is more unsure says nothing
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class _MotionSteps:
    """Motions between neighbouring cameras of the scene, each in the frame of its first camera."""

    names: tuple[tuple[str, str], ...]
    scene: Array  # (K, 3) from camera to camera, in the scene's unit
    given: Array  # (K, 3) metres
    turned_deg: Array  # (K,) by which the rotations differ
    sigma_m: Array  # (K,) in each direction
    sigma_deg: Array  # (K,) about each axis
    bounds: Array  # (K,) standard deviation of `scene`, in each direction

    def normalize_errors(self, scale: float) -> Array:
        """(K, 3) the errors over their standard deviations: along the motion, and twice across it."""
        off = scale * self.scene - self.given
        length = np.linalg.norm(self.given, axis=1)
        ahead = self.given / np.maximum(length, 1e-12)[:, None]
        along = (off * ahead).sum(1)
        across = off - along[:, None] * ahead
        sigma = np.hypot(self.sigma_m, scale * self.bounds)
        turned = np.hypot(sigma, np.radians(np.hypot(self.sigma_deg, _LEAST_DEG)) * length)
        return np.column_stack([along / sigma, np.linalg.norm(across, axis=1) / turned])

    def find_fitting(self, scale: float) -> Mask:
        near = np.linalg.norm(self.normalize_errors(scale), axis=1) < _FARTHEST
        return near & (self.turned_deg < _FARTHEST * np.hypot(self.sigma_deg, _LEAST_DEG))

    def cost(self, scale: float, kept: Mask) -> float:
        return float((self.normalize_errors(scale)[kept] ** 2).sum())


def estimate_scale_from_motions(
    views: Mapping[str, MetricView], motions: Mapping[str, Motion], shared: float
) -> list[Measurement | str]:
    """Estimates the scale, with a sentence for each motion that was left out; else one on why not.

    `views` are in the order of the way. `shared` is the standard deviation of an error that all motions have alike, as
    a share of their length. Nothing of motions that all are the first of their chain.
    """
    if not any(motion.sigma_m for motion in motions.values()):
        return []
    steps = _collect_steps(views, motions)
    if steps is None:
        return ["motions were given, and none of them is between two cameras of the scene that follow one another"]
    count = len(steps.names)
    scale, kept = _find_consensus(steps)
    if kept.sum() < max(1, math.ceil(_LEAST_FITTING * count)):
        return [
            f"motions between {_format_pair_count(count)} were given, of which no more than {kept.sum()} fit the "
            "cameras of the "
            "scene: are they of the camera, with x right, y down and z forward, and in metres?"
        ]
    sigma = _estimate_sigma(steps, scale, kept)
    if sigma > _LEAST_KNOWN:
        return [f"motions between {_format_pair_count(count)} were given, which are not longer than they are unsure"]
    off = np.linalg.norm(scale * steps.scene - steps.given, axis=1)
    notes = [
        f"the motion from {first} to {second} was left out: it is {off[i]:.2g} m and {steps.turned_deg[i]:.2g} degrees "
        "off"
        for i, (first, second) in enumerate(steps.names)
        if not kept[i]
    ]
    unit = Measurement(scale, math.hypot(sigma, shared), f"motions between {_format_pair_count(int(kept.sum()))}")
    return [unit, *notes]


def _format_pair_count(count: int) -> str:
    return "one pair of photographs" if count == 1 else f"{count} pairs of photographs"


def _collect_steps(views: Mapping[str, MetricView], motions: Mapping[str, Motion]) -> _MotionSteps | None:
    known = [name for name in views if name in motions]
    pairs = [(a, b) for a, b in pairwise(known) if _follows(motions[a], motions[b])]
    if not pairs:
        return None
    one, other = ([views[pair[i]] for pair in pairs] for i in (0, 1))
    firsts, seconds = ([motions[pair[i]] for pair in pairs] for i in (0, 1))
    of_scene = np.stack([_relative(a.T_world_camera, b.T_world_camera) for a, b in zip(one, other, strict=True)])
    given = np.stack([_relative(a.matrix, b.matrix) for a, b in zip(firsts, seconds, strict=True)])
    return _MotionSteps(
        names=tuple(pairs),
        scene=of_scene[:, :3, 3],
        given=given[:, :3, 3],
        turned_deg=angles_deg(of_scene[:, :3, :3], given[:, :3, :3]),
        sigma_m=np.sqrt([b.sigma_m**2 - a.sigma_m**2 for a, b in zip(firsts, seconds, strict=True)]),
        sigma_deg=np.sqrt([b.sigma_deg**2 - a.sigma_deg**2 for a, b in zip(firsts, seconds, strict=True)]),
        bounds=np.array([math.hypot(a.bound, b.bound) for a, b in zip(one, other, strict=True)]) / TWO_SIDED_95,
    )


def _follows(first: Motion, second: Motion) -> bool:
    """Whether the one is later in the same chain; a recording that is shown again begins it anew."""
    later = second.sigma_m > first.sigma_m and second.sigma_deg > first.sigma_deg
    return first.chain == second.chain and later


def _relative(first: Array, second: Array) -> Array:
    return np.linalg.inv(first) @ second


def _find_consensus(steps: _MotionSteps) -> tuple[float, Mask]:
    """The unit that most motions agree on, and which do: first by that of each of them, then by all that fit."""
    lengths = np.linalg.norm(steps.scene, axis=1), np.linalg.norm(steps.given, axis=1)
    moved = (lengths[0] > 0) & (lengths[1] > 0)
    proposals = (lengths[1][moved] / lengths[0][moved]).tolist()
    if not proposals:
        return 1.0, np.zeros(len(steps.names), bool)

    def cost(scale: float) -> float:
        return float(np.minimum((steps.normalize_errors(scale) ** 2).sum(1), _FARTHEST**2).sum())

    scale = min(proposals, key=cost)
    kept = steps.find_fitting(scale)
    for _ in range(_ROUNDS):
        if not kept.any():
            break
        scale = _minimize_cost(steps, scale, kept)
        now = steps.find_fitting(scale)
        if (now == kept).all():
            break
        kept = now
    return scale, kept


def _minimize_cost(steps: _MotionSteps, near: float, kept: Mask) -> float:
    """The unit with the least squares, errors of the cameras counted like those of the motions."""

    def cost(log: float) -> float:
        return steps.cost(near * math.exp(log), kept)

    span = math.log(2.0)
    found = minimize_scalar(cost, bounds=(-span, span), method="bounded", options={"xatol": 1e-6})
    return near * math.exp(float(found.x))


def _estimate_sigma(steps: _MotionSteps, scale: float, kept: Mask) -> float:
    """Standard deviation of the log of the unit; wider where motions scatter more than they should."""
    length = (scale * steps.scene * steps.given).sum(1) / np.maximum(np.linalg.norm(steps.given, axis=1), 1e-12)
    sigma = np.hypot(steps.sigma_m, scale * steps.bounds)
    known = float(((length[kept] / sigma[kept]) ** 2).sum())
    wider = max(1.0, steps.cost(scale, kept) / max(3 * int(kept.sum()) - 1, 1))
    return math.inf if known <= 0 else math.sqrt(wider / known)


# Where up is in a scene, by what an IMU says of gravity in the frames of its cameras.


_MAX_SIGMAS_2D = 3.44  # standard deviations in two dimensions: what one has within 3 in one dimension, 99.7 %
_SHARED_DEG = 0.5  # standard deviation of an error that all have alike: how the IMU is mounted


def estimate_up(views: Mapping[str, MetricView], gravities: Mapping[str, Gravity]) -> Up | None:
    """Up in the world of the cameras; None where nothing was said, or less than 60 % of it agrees.

    The source names the photographs whose gravity was left out because it does not fit the others.
    """
    names = [name for name in views if name in gravities]
    if not names:
        return None
    ups = np.stack([-views[name].T_world_camera[:3, :3] @ gravities[name].direction for name in names])
    sigmas = np.array([gravities[name].sigma_deg for name in names])
    up = ups[np.argmin([_compute_truncated_cost(ups, sigmas, each) for each in ups])]
    kept = np.zeros(len(names), bool)
    for _ in range(_ROUNDS):
        fits = _compute_angles_deg(ups, up) < _MAX_SIGMAS_2D * np.hypot(sigmas, _SHARED_DEG)
        if not fits.any() or (fits == kept).all():
            break
        kept = fits
        mean = (ups[kept] / sigmas[kept, None] ** 2).sum(0)
        up = mean / np.linalg.norm(mean)
    if kept.sum() < math.ceil(_LEAST_FITTING * len(names)):
        return None
    wider = max(
        1.0, float(((_compute_angles_deg(ups[kept], up) / sigmas[kept]) ** 2).sum()) / max(2 * int(kept.sum()) - 2, 1)
    )
    sigma = math.hypot(math.sqrt(wider / float((sigmas[kept] ** -2.0).sum())), _SHARED_DEG)
    x, y, z = up.tolist()
    return Up((x, y, z), sigma, _source(names, kept))


def _source(names: list[str], kept: npt.NDArray[np.bool_]) -> str:
    left_out = [name for name, fits in zip(names, kept, strict=True) if not fits]
    said = f"gravity in {kept.sum()} photographs"
    return f"{said}; that of {', '.join(left_out)} was left out: it does not fit the others" if left_out else said


def _compute_truncated_cost(ups: Array, sigmas: Array, up: Array) -> float:
    return float(np.minimum((_compute_angles_deg(ups, up) / sigmas) ** 2, _MAX_SIGMAS_2D**2).sum())


def _compute_angles_deg(ups: Array, up: Array) -> Array:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(ups, up), axis=1), ups @ up))


# Where a scene lies in the world of given poses: errors that add up along the way are told from those that do not.
#
# Odometry is right where it begins, and drifts: the errors of two poses have in common what had grown until the
# earlier one. A tracker's, an arm's or a satellite receiver's errors are each pose's own. What poses have of both is
# estimated by restricted maximum likelihood (Patterson and Thompson 1971), and the scene is placed by generalised least
# squares: on the first poses where errors add up, on the mean of all where they do not.

_MOST_POSES = 150  # that are looked at, evenly along the way: covariances have six rows for each
# Times what was told, for each kind of error; 0: it has none of that kind
_FACTORS = (0.0, *(2.0**power for power in range(-7, 5)))
_WIDTH = math.log(8.0)  # standard deviation of the logarithm of such a factor, before anything is known
# The logarithm of how much likelier than what was told it is that there is none of a kind, before anything is known
_NO_OWN, _NO_STEPS = -2.0, 2.0
_NOISE_ROUNDS = 5
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
        for _ in range(_NOISE_ROUNDS):
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
    for _ in range(_NOISE_ROUNDS if believed.sum() >= _LEAST_POSES else 0):
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


# Unit and orientation by poses that others estimated: odometry, a tracker, a drone's log.
#
# The cameras of the scene are carried onto the poses by the similarity that most of them agree on. A pose that does
# not fit is named and left out. Neither the photographs' cameras nor the scene are changed by them otherwise.


_MAX_SIGMAS_3D = 3.76  # standard deviations in three dimensions: what one has within 3 in one dimension, 99.7 %
# What poses that scatter more than was given are believed to scatter at most: as a share of their spread, and degrees.
_MOST_SHARE, _MOST_DEG = 0.05, 15.0
_DRIFT_LEFT = 0.5  # of the drift at the end of the way, in one direction: what is left of it beside the best similarity
_TO_SIGMA = 0.65  # standard deviation in one dimension over the median length in three
_MOST_PAIRS = 500  # of cameras, each of which proposes a similarity
# Standard deviations of a camera of the scene, at least: radians, and a share of the poses' spread
_LEAST_TURN, _LEAST_SHIFT = math.radians(0.01), 1e-4


@dataclass(frozen=True, eq=False)
class PoseAlignment:
    """The alignment of a scene to given poses."""

    unit: Measurement
    to_world: Similarity  # from the scene to the world of the poses
    centre: Array  # (3,) mean of the cameras that count, in the scene
    notes: tuple[str, ...]  # a sentence for each pose that was left out
    placement: PosePlacement | None = None  # by the errors that the poses have; None: nothing is known of these

    def rescale(self, scale: float) -> Similarity:
        """The similarity with another scale, where the poses place that; else with the cameras' middle where it is."""
        if self.placement is not None:
            return self.placement.place(scale)
        rotation = self.to_world.rotation
        return Similarity(scale, rotation, self.to_world(self.centre) - scale * rotation @ self.centre)


@dataclass(frozen=True)
class PoseSigmas:
    """Standard deviations of given poses."""

    position_m: float  # of each position, in each direction
    rotation_deg: float  # of each orientation, about each axis
    drift: float  # of the error that has grown at the end of the way, as a share of the way


@dataclass(frozen=True, eq=False)
class _CameraPairs:
    """Cameras of the scene and the poses given for them."""

    names: tuple[str, ...]
    scene: Array  # (C, 4, 4)
    given: Array  # (C, 4, 4)
    bounds: Array  # (C,) 95 % of the cameras' centres, in the scene's unit
    bounds_deg: Array  # (C,) and of their orientations, degrees

    @classmethod
    def collect(cls, views: Mapping[str, MetricView], poses: Mapping[str, Array]) -> _CameraPairs:
        """The cameras that have a pose, in the order of the views."""
        chosen = {name: view for name, view in views.items() if name in poses}
        return cls(
            tuple(chosen),
            np.stack([view.T_world_camera for view in chosen.values()]),
            np.stack([poses[name] for name in chosen]),
            np.array([view.bound for view in chosen.values()]),
            np.array([view.bound_deg for view in chosen.values()]),
        )

    def make_scene_sigmas(self, scale: float) -> Array:
        """(C, 2) standard deviations of the cameras' turns, radians, and of their centres, metres, at most.

        Bounds hold what all cameras have wrong together, too: how the scene is bent.
        """
        return np.column_stack([np.radians(self.bounds_deg), scale * self.bounds]) / TWO_SIDED_95

    @property
    def least_sigmas(self) -> Array:
        """(2,) likewise, at least."""
        return np.array([_LEAST_TURN, _LEAST_SHIFT * compute_rms_radius(self.given[:, :3, 3])])

    def compute_errors(self, by: Similarity) -> tuple[Array, Array]:
        """Metres (C,) and degrees (C,) by which each pose is off."""
        turned = by.rotation @ self.scene[:, :3, :3]
        return np.linalg.norm(by(self.scene[:, :3, 3]) - self.given[:, :3, 3], axis=1), angles_deg(
            turned, self.given[:, :3, :3]
        )

    def sigma_m(self, by: Similarity, position_m: Array) -> Array:
        """(C,) standard deviation of the difference in each direction."""
        return np.hypot(position_m, by.scale * self.bounds / TWO_SIDED_95)


def align_to_poses(
    views: Mapping[str, MetricView],
    poses: Mapping[str, Array],
    sigmas: PoseSigmas,
    own: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> PoseAlignment | str:
    """Aligns the scene to `poses` (4, 4) T_world_camera, metres, by image name; else returns why not.

    `views` are in the order of the way, along which poses drift. Where poses scatter more than `sigmas` say, what they
    scatter counts. `own` are the standard deviations, metres and degrees, of poses that have their own.
    """
    names = tuple(name for name in views if name in poses)
    if len(names) < 2:
        return f"poses were given, and {len(names) or 'none'} of them is of a camera of the scene; two are needed"
    pairs = _CameraPairs.collect(views, poses)
    usual = sigmas.position_m, sigmas.rotation_deg
    position_m, rotation_deg = np.array([own.get(name, usual) for name in names]).T
    if compute_rms_radius(pairs.given[:, :3, 3]) <= np.median(position_m):
        return f"poses of {len(names)} photographs were given, which are not farther apart than they are unsure"
    by, kept, scattered_deg = _find_pose_consensus(pairs, position_m, rotation_deg, sigmas.drift)
    if kept.sum() < _count_required(len(names)):
        return (
            f"poses of {len(names)} photographs were given, of which no more than {kept.sum()} fit the cameras of the "
            "scene: are they of the cameras, with x right, y down and z forward, and in metres?"
        )
    noise = _describe_noise(pairs, by, position_m, rotation_deg, sigmas.drift)
    placement = fit_placement(pairs.scene, pairs.given, by, kept, noise)
    kept = placement.fits
    by, sigma = _refine_similarity(pairs, by, kept, position_m, scattered_deg, sigmas.drift)
    off_m, off_deg = pairs.compute_errors(by)
    notes = tuple(
        f"the pose of {name} was left out: it is {_format_error(off_m[i], off_deg[i], scattered_deg[i])} off"
        for i, name in enumerate(names)
        if not kept[i]
    )
    unit = Measurement(by.scale, sigma, f"poses of {kept.sum()} photographs")
    return PoseAlignment(unit, placement.place(by.scale), pairs.scene[kept, :3, 3].mean(0), notes, placement)


def _describe_noise(
    pairs: _CameraPairs, by: Similarity, position_m: Array, rotation_deg: Array, drift: float
) -> PoseNoise:
    """Describes the errors as they were told: at the end of the way turns have grown to the drift, in radians."""
    steps = np.linalg.norm(np.diff(pairs.given[:, :3, 3], axis=0), axis=1)
    turns = np.radians(angles_deg(pairs.given[:-1, :3, :3], pairs.given[1:, :3, :3]))
    ahead = steps / max(float(steps.sum()), 1e-12)  # shares of the way, and of all turns
    turned = (ahead + turns / max(float(turns.sum()), 1e-12)) / 2.0
    grown = np.column_stack([drift * np.sqrt(turned), drift * steps.sum() * np.sqrt(ahead / 3.0)])
    own = np.hypot(np.column_stack([np.radians(rotation_deg), position_m]), pairs.make_scene_sigmas(by.scale))
    return PoseNoise(own, np.vstack([np.zeros(2), grown]), pairs.least_sigmas)


def align_to_motions(
    views: Mapping[str, MetricView], motions: Mapping[str, Motion], poses: Mapping[str, Array]
) -> PosePlacement | str:
    """Places the scene in the frame in which one chain of motions began; else returns why it cannot.

    `poses` are the (4, 4) T_start_camera to which the motions add up, by image name. A motion that the images
    contradict parts what follows it from the start. `views` are in the order of the way.
    """
    steps = _collect_steps(views, {name: each for name, each in motions.items() if name in poses})
    names = [name for name in views if name in poses]
    if steps is None or len(steps.names) < len(names) - 1:
        return f"motions of {len(names)} images were given, which are not in the order of their chain"
    _, fitting = _find_consensus(steps)
    pairs = _CameraPairs.collect(views, poses)
    grown = np.vstack([np.zeros(2), np.column_stack([np.radians(steps.sigma_deg), steps.sigma_m])])
    turn = pairs.given[0, :3, :3] @ pairs.scene[0, :3, :3].T
    scale = compute_rms_radius(pairs.given[:, :3, 3]) / max(compute_rms_radius(pairs.scene[:, :3, 3]), 1e-12)
    begun = Similarity(scale, turn, pairs.given[0, :3, 3] - scale * turn @ pairs.scene[0, :3, 3])
    own = np.hypot(np.median(grown[1:], axis=0), pairs.make_scene_sigmas(scale))
    noise = PoseNoise(own, grown, pairs.least_sigmas)
    noise = part_steps(noise, np.concatenate([[False], ~fitting]), float(np.ptp(pairs.given[:, :3, 3], axis=0).max()))
    return fit_placement(pairs.scene, pairs.given, begun, np.ones(len(names), bool), noise)


def _format_error(metres: float, degrees: float, rotation_deg: float) -> str:
    turned = f"{degrees:.2g} degrees" if degrees > _MAX_SIGMAS_3D * rotation_deg else ""
    return " and ".join(filter(None, (f"{metres:.2g} m", turned)))


def _find_pose_consensus(
    pairs: _CameraPairs, position_m: Array, rotation_deg: Array, drift: float
) -> tuple[Similarity, Mask, Array]:
    """The similarity, which poses fit it, and the standard deviations (C,) of the orientations among them, degrees.

    First with what was given; where too few fit then, with what the poses scatter.
    """
    way = float(np.linalg.norm(np.diff(pairs.given[:, :3, 3], axis=0), axis=1).sum())
    position_m = np.hypot(position_m, _DRIFT_LEFT * drift * way)
    by = _propose_similarity(pairs, position_m, rotation_deg)
    by, kept = _refine_inliers(pairs, by, position_m, rotation_deg)
    if kept.sum() < _count_required(len(kept)):
        off_m, off_deg = pairs.compute_errors(_propose_similarity(pairs, position_m, rotation_deg, by_most=True))
        least_m = min(_MOST_SHARE * compute_rms_radius(pairs.given[:, :3, 3]), _TO_SIGMA * float(np.median(off_m)))
        least_deg = min(_MOST_DEG, _TO_SIGMA * float(np.median(off_deg)))
        position_m, rotation_deg = np.maximum(position_m, least_m), np.maximum(rotation_deg, least_deg)
        by, kept = _refine_inliers(
            pairs, _propose_similarity(pairs, position_m, rotation_deg), position_m, rotation_deg
        )
    return by, kept, rotation_deg


def _count_required(count: int) -> int:
    """Returns how many of `count` poses must fit."""
    return max(2, math.ceil(_LEAST_FITTING * count))


def _refine_inliers(
    pairs: _CameraPairs, by: Similarity, position_m: Array, rotation_deg: Array
) -> tuple[Similarity, Mask]:
    """The similarity that the poses which fit it agree on."""
    kept = np.zeros(len(pairs.names), bool)
    for _ in range(_ROUNDS):
        off_m, off_deg = pairs.compute_errors(by)
        fits = (off_m < _MAX_SIGMAS_3D * pairs.sigma_m(by, position_m)) & (off_deg < _MAX_SIGMAS_3D * rotation_deg)
        if fits.sum() < 2 or (fits == kept).all():
            return by, fits
        kept = fits
        by, _ = _refine_similarity(pairs, by, kept, position_m, rotation_deg)
    return by, kept


def _propose_similarity(
    pairs: _CameraPairs, position_m: Array, rotation_deg: Array, by_most: bool = False
) -> Similarity:
    """Returns the similarity that the poses fit best, of those of two cameras each and that of all.

    What does not fit counts no more than what hardly does; `by_most`: by the median, however far the others are off.
    """
    chosen = list(combinations(range(len(pairs.names)), 2))
    chosen = chosen[:: -(-len(chosen) // _MOST_PAIRS)]
    proposals = [align_cameras(pairs.scene[list(two)], pairs.given[list(two)]) for two in chosen]
    proposals.append(align_cameras(pairs.scene, pairs.given))

    def cost(by: Similarity) -> float:
        off_m, off_deg = pairs.compute_errors(by)
        squares = (off_m / pairs.sigma_m(by, position_m)) ** 2 + (off_deg / rotation_deg) ** 2
        return float(np.median(squares) if by_most else np.minimum(squares, 2.0 * _MAX_SIGMAS_3D**2).sum())

    return min(proposals, key=cost)


def _refine_similarity(
    pairs: _CameraPairs, by: Similarity, kept: Mask, position_m: Array, rotation_deg: Array, drift: float = 0.0
) -> tuple[Similarity, float]:
    """The similarity with the least weighted squares over the poses that are kept; sigma of its log scale.

    With `drift`, errors of positions that follow one another are alike: they grow at random along the way.
    """
    scene, given = pairs.scene[kept], pairs.given[kept]
    middle, size = scene[:, :3, 3].mean(0), by.scale * max(compute_rms_radius(scene[:, :3, 3]), 1e-12)
    covariance = np.diag(pairs.sigma_m(by, position_m)[kept] ** 2) + _compute_drift_covariance(given[:, :3, 3], drift)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))

    def move_similarity(values: Array) -> Similarity:
        rotation = Rotation.from_rotvec(values[:3]).as_matrix() @ by.rotation
        scale = by.scale * math.exp(values[6])
        return Similarity(scale, rotation, by(middle) + size * values[3:6] - scale * rotation @ middle)

    def errors(values: Array) -> Array:
        to = move_similarity(values)
        positions = whitening @ (to(scene[:, :3, 3]) - given[:, :3, 3])
        turns = Rotation.from_matrix(np.swapaxes(given[:, :3, :3], 1, 2) @ to.rotation @ scene[:, :3, :3]).as_rotvec()
        return np.concatenate([positions.ravel(), (turns / np.radians(rotation_deg[kept])[:, None]).ravel()])

    found = least_squares(errors, np.zeros(7), method="lm", x_scale=np.full(7, 0.01))
    of_values = np.linalg.pinv(found.jac.T @ found.jac)
    wider = max(1.0, 2.0 * found.cost / max(6 * len(scene) - 7, 1))  # where they scatter more than they should
    return move_similarity(found.x), math.sqrt(max(float(of_values[6, 6]) * wider, 0.0))


def _compute_drift_covariance(positions: Array, drift: float) -> Array:
    """(C, C) covariance, in each direction, of errors that add up step by step to `drift` of the way at its end."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    return drift**2 / 3.0 * way[-1] * np.minimum(way[:, None], way[None, :])
