"""Bundle adjustment for few views: Levenberg-Marquardt on robust reprojection errors, points eliminated by Schur.

With at most a few dozen cameras the reduced camera system is tiny and dense, so that everything is a handful of
vectorised NumPy operations. Doing it here gives what few views need: priors on the focal length, and the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Problem:
    """C cameras, G lenses (groups of cameras that share them), P points, O observations."""

    rotations: Array  # (C, 3, 3) world to camera
    translations: Array  # (C, 3) world to camera
    lens_of_camera: Index  # (C,)
    log_focals: Array  # (G,) log of the focal length in pixels
    radials: Array  # (G,) first radial coefficient: distorted = undistorted * (1 + k r^2)
    points: Array  # (P, 3)
    camera_of: Index  # (O,)
    point_of: Index  # (O,)
    pixels: Array  # (O, 2) relative to the principal point


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    robust_px: float = 1.0  # scale of the Cauchy loss, pixels
    max_iterations: int = 40
    tolerance: float = 1e-5  # relative decrease of the cost at which it stops


@dataclass(frozen=True, eq=False)
class FocalPrior:
    """Gaussian priors on the logarithm of each lens' focal length and on its radial coefficient."""

    log_focals: Array  # (G,)
    sigmas: Array  # (G,) of log focal; 0 fixes it
    radial_sigmas: Array  # (G,) around zero; 0 fixes the coefficient at its value


def project(problem: Problem) -> tuple[Array, Array]:
    """Predicted pixels (O, 2) relative to the principal point, and depths (O,)."""
    camera, lens = problem.camera_of, problem.lens_of_camera[problem.camera_of]
    in_camera = (
        np.einsum("oij,oj->oi", problem.rotations[camera], problem.points[problem.point_of])
        + problem.translations[camera]
    )
    normalised = in_camera[:, :2] / _safe_depth(in_camera[:, 2:])
    distortion = 1.0 + problem.radials[lens] * (normalised**2).sum(1)
    return normalised * (np.exp(problem.log_focals[lens]) * distortion)[:, None], in_camera[:, 2]


def reprojection_errors(problem: Problem) -> Array:
    """(O,) pixels; infinite behind the camera."""
    predicted, depth = project(problem)
    return np.where(depth > 0, np.linalg.norm(predicted - problem.pixels, axis=1), np.inf)


def adjust(problem: Problem, prior: FocalPrior, config: Config, fixed_camera: int = 0) -> Problem:
    """The problem after minimising the robust cost. Camera `fixed_camera` stays where it is."""
    damping, cost = 1e-4, _cost(problem, prior, config)
    for _ in range(config.max_iterations):
        system = _linearise(problem, prior, config, fixed_camera)
        for _ in range(8):
            candidate = _step(problem, system, damping)
            new_cost = _cost(candidate, prior, config)
            if new_cost < cost:
                break
            damping *= 4.0
        else:
            return problem
        decrease, problem, cost = (cost - new_cost) / cost, candidate, new_cost
        damping = max(damping / 5.0, 1e-9)
        if decrease < config.tolerance:
            return problem
    return problem


def covariance(problem: Problem, prior: FocalPrior, config: Config, fixed_camera: int = 0) -> Array:
    """(C, 6, 6) covariance of each camera's rotation vector (radians) and translation, world to camera.

    Relative to the fixed camera; the free scale of the scene is left out (pseudo-inverse).
    """
    system = _linearise(problem, prior, config, fixed_camera)
    reduced, _ = _reduce(system, 0.0)
    errors = np.minimum(reprojection_errors(problem), 10.0)
    freedom = max(1, 2 * len(errors) - reduced.shape[0] - 3 * len(problem.points))
    variance = 2.0 * float((_robust_weight(errors**2, config) * errors**2).sum()) / freedom / 2.0
    values, vectors = np.linalg.eigh(reduced)
    keep = values > values[-1] * 1e-12
    keep[0] = False  # the scale: the direction in which nothing changes
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T * variance
    count = len(problem.rotations)
    full = np.zeros((count * 6 + 2 * len(problem.log_focals),) * 2)
    full[np.ix_(system.free, system.free)] = inverse
    return np.stack([full[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] for c in range(count)])


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations in blocks: D free camera and lens parameters, P points."""

    free: Index  # (D,) positions among all 6 C + 2 G parameters
    cameras: Array  # (D, D)
    cameras_gradient: Array  # (D,)
    points: Array  # (P, 3, 3)
    points_gradient: Array  # (P, 3)
    mixed: Array  # (P, D, 3)


def _safe_depth(depth: Array) -> Array:
    return np.where(np.abs(depth) < 1e-9, 1e-9, depth)


def _robust_weight(squared: Array, config: Config) -> Array:
    return 1.0 / (1.0 + squared / config.robust_px**2)


def _cost(problem: Problem, prior: FocalPrior, config: Config) -> float:
    predicted, depth = project(problem)
    squared = ((predicted - problem.pixels) ** 2).sum(1)
    squared = np.where(depth > 0, squared, 1e6)
    cost = config.robust_px**2 * np.log1p(squared / config.robust_px**2).sum()
    focal, radial = prior.sigmas > 0, prior.radial_sigmas > 0
    cost += (((problem.log_focals - prior.log_focals)[focal] / prior.sigmas[focal]) ** 2).sum()
    return float(cost + ((problem.radials[radial] / prior.radial_sigmas[radial]) ** 2).sum())


def _linearise(problem: Problem, prior: FocalPrior, config: Config, fixed_camera: int) -> _System:
    num_cameras, num_lenses, num_points = len(problem.rotations), len(problem.log_focals), len(problem.points)
    camera, point = problem.camera_of, problem.point_of
    lens = problem.lens_of_camera[camera]
    rotation = problem.rotations[camera]
    turned = np.einsum("oij,oj->oi", rotation, problem.points[point])
    in_camera = turned + problem.translations[camera]
    depth = _safe_depth(in_camera[:, 2])
    u, v = in_camera[:, 0] / depth, in_camera[:, 1] / depth
    focal, radial = np.exp(problem.log_focals[lens]), problem.radials[lens]
    squared_radius = u * u + v * v
    distortion = 1.0 + radial * squared_radius
    residual = np.stack([u, v], 1) * (focal * distortion)[:, None] - problem.pixels
    weight = _robust_weight((residual**2).sum(1), config) * (in_camera[:, 2] > 0)

    by_normalised = np.empty((len(u), 2, 2))
    by_normalised[:, 0, 0] = focal * (distortion + 2 * radial * u * u)
    by_normalised[:, 1, 1] = focal * (distortion + 2 * radial * v * v)
    by_normalised[:, 0, 1] = by_normalised[:, 1, 0] = focal * 2 * radial * u * v
    by_position = np.empty((len(u), 2, 3))
    by_position[:, :, :2] = by_normalised / depth[:, None, None]
    by_position[:, :, 2] = -(by_normalised @ np.stack([u, v], 1)[:, :, None])[:, :, 0] / depth[:, None]
    jacobian = np.empty((len(u), 2, 8))  # rotation, translation, log focal, radial
    jacobian[:, :, 0:3] = -by_position @ cross_matrix(turned)
    jacobian[:, :, 3:6] = by_position
    jacobian[:, :, 6] = np.stack([u, v], 1) * (focal * distortion)[:, None]
    jacobian[:, :, 7] = np.stack([u, v], 1) * (focal * squared_radius)[:, None]
    by_point = by_position @ rotation

    num_parameters = 6 * num_cameras + 2 * num_lenses
    columns = np.empty((len(u), 8), np.int64)
    columns[:, :6] = 6 * camera[:, None] + np.arange(6)
    columns[:, 6] = 6 * num_cameras + 2 * lens
    columns[:, 7] = columns[:, 6] + 1
    weighted = jacobian * weight[:, None, None]

    def scatter(values: Array, index: Index, size: int) -> Array:
        return np.bincount(index.ravel(), weights=values.ravel(), minlength=size)

    pair_index = columns[:, :, None] * num_parameters + columns[:, None, :]
    cameras = scatter(np.einsum("oki,okj->oij", weighted, jacobian), pair_index, num_parameters**2)
    cameras = cameras.reshape(num_parameters, num_parameters)
    gradient = scatter(np.einsum("oki,ok->oi", weighted, residual), columns, num_parameters)
    mixed_index = (point[:, None, None] * num_parameters + columns[:, :, None]) * 3 + np.arange(3)
    mixed = scatter(np.einsum("oki,okj->oij", weighted, by_point), mixed_index, num_points * num_parameters * 3)
    weighted_point = by_point * weight[:, None, None]
    point_index = point[:, None, None] * 9 + np.arange(9).reshape(3, 3)
    points = scatter(np.einsum("oki,okj->oij", weighted_point, by_point), point_index, num_points * 9)
    points_gradient = scatter(
        np.einsum("oki,ok->oi", weighted_point, residual), point[:, None] * 3 + np.arange(3), num_points * 3
    )
    free = np.ones(num_parameters, bool)
    free[6 * fixed_camera : 6 * fixed_camera + 6] = False
    for group in range(num_lenses):
        at = 6 * num_cameras + 2 * group
        pulls = (
            (at, prior.sigmas[group], problem.log_focals[group] - prior.log_focals[group]),
            (at + 1, prior.radial_sigmas[group], problem.radials[group]),
        )
        for column, sigma, deviation in pulls:
            if sigma > 0:
                cameras[column, column] += 1.0 / sigma**2
                gradient[column] += deviation / sigma**2
            else:
                free[column] = False
    (kept,) = np.nonzero(free)
    return _System(
        free=kept,
        cameras=cameras[np.ix_(kept, kept)],
        cameras_gradient=gradient[kept],
        points=points.reshape(num_points, 3, 3),
        points_gradient=points_gradient.reshape(num_points, 3),
        mixed=mixed.reshape(num_points, num_parameters, 3)[:, kept],
    )


def _reduce(system: _System, damping: float) -> tuple[Array, Array]:
    """The camera system after eliminating the points (Schur complement), and the points' inverse blocks."""
    diagonal = np.einsum("pii->pi", system.points) * damping + 1e-12
    inverse = np.linalg.inv(system.points + diagonal[:, :, None] * np.eye(3))
    size = len(system.free)
    spread = np.einsum("pdi,pij->pdj", system.mixed, inverse)
    across = np.tensordot(spread, system.mixed, axes=([0, 2], [0, 2]))
    reduced = system.cameras + np.diag(np.diag(system.cameras) * damping + 1e-12) - across
    return reduced.reshape(size, size), inverse


def _step(problem: Problem, system: _System, damping: float) -> Problem:
    reduced, inverse = _reduce(system, damping)
    point_part = np.einsum("pij,pj->pi", inverse, system.points_gradient)
    right = -(system.cameras_gradient - np.tensordot(system.mixed, point_part, axes=([0, 2], [0, 1])))
    step = np.linalg.lstsq(reduced, right, rcond=None)[0]
    move_points = -point_part - np.einsum("pij,pdj,d->pi", inverse, system.mixed, step, optimize=True)
    num_cameras = len(problem.rotations)
    full = np.zeros(6 * num_cameras + 2 * len(problem.log_focals))
    full[system.free] = step
    cameras, lenses = full[: 6 * num_cameras].reshape(-1, 6), full[6 * num_cameras :].reshape(-1, 2)
    turn = rotation_from_vector(cameras[:, :3])
    return replace(
        problem,
        rotations=turn @ problem.rotations,
        translations=problem.translations + cameras[:, 3:],
        log_focals=problem.log_focals + np.clip(lenses[:, 0], -0.5, 0.5),
        radials=problem.radials + np.clip(lenses[:, 1], -0.2, 0.2),
        points=problem.points + move_points,
    )


def cross_matrix(vectors: Array) -> Array:
    """(M, 3, 3) matrices with cross_matrix(v) @ x = v x x."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)


def rotation_from_vector(vectors: Array) -> Array:
    """(M, 3, 3) rotations by the angle |v| about v (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    cross = cross_matrix(vectors)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0, np.sin(safe) / safe)
    second = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    return np.eye(3) + first * cross + second * (cross @ cross)
