"""Bundle adjustment for few views: Levenberg-Marquardt on robust reprojection errors, points eliminated by Schur.

The work is done in recon/core/bundle.cpp: a few milliseconds an iteration, so that many hypotheses can be tried. Doing
it here gives what few views need: priors on the focal length, and the covariance.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, pointer

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
    shifts: Array  # (G, 2) of the principal point, pixels
    points: Array  # (P, 3)
    camera_of: Index  # (O,)
    point_of: Index  # (O,)
    pixels: Array  # (O, 2) relative to the nominal principal point


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    robust_px: float = 1.0  # scale of the Cauchy loss, pixels
    noise_px: float = 1.0  # standard deviation that an observation counts with against the priors, pixels
    max_iterations: int = 40
    tolerance: float = 1e-5  # relative decrease of the cost at which it stops


@dataclass(frozen=True, eq=False)
class LensPrior:
    """Gaussian priors on each lens' log focal length, radial coefficient and principal point; a sigma of 0 fixes."""

    log_focals: Array  # (G,)
    sigmas: Array  # (G,) of log focal
    radial_sigmas: Array  # (G,) around zero
    shift_sigmas: Array  # (G,) pixels around the nominal principal point


def project(problem: Problem) -> tuple[Array, Array]:
    """Predicted pixels (O, 2) relative to the nominal principal point, and depths (O,)."""
    camera, lens = problem.camera_of, problem.lens_of_camera[problem.camera_of]
    in_camera = (
        np.einsum("oij,oj->oi", problem.rotations[camera], problem.points[problem.point_of])
        + problem.translations[camera]
    )
    normalised = in_camera[:, :2] / _safe_depth(in_camera[:, 2:])
    distortion = 1.0 + problem.radials[lens] * (normalised**2).sum(1)
    focal = np.exp(problem.log_focals[lens])
    return normalised * (focal * distortion)[:, None] + problem.shifts[lens], in_camera[:, 2]


def reprojection_errors(problem: Problem) -> Array:
    """(O,) pixels; infinite behind the camera."""
    predicted, depth = project(problem)
    return np.where(depth > 0, np.linalg.norm(predicted - problem.pixels, axis=1), np.inf)


def robust_cost(problem: Problem, config: Config) -> float:
    """The Cauchy loss of all observations, pixels squared; priors left out. One behind its camera costs as 1000 px."""
    squared = np.minimum(reprojection_errors(problem), 1e3) ** 2
    return float(config.robust_px**2 * np.log1p(squared / config.robust_px**2).sum())


def adjust(problem: Problem, prior: LensPrior, config: Config, fixed_camera: int = 0) -> Problem:
    """The problem after minimising the robust cost. Camera `fixed_camera` stays where it is."""
    problem = _copy(_by_point(problem))
    native, _arrays = _native(problem, prior, config, fixed_camera)
    core = library()
    core.core_bundle_adjust.restype = ctypes.c_double
    core.core_bundle_adjust(ctypes.byref(native), config.max_iterations, ctypes.c_double(config.tolerance))
    return problem


@dataclass(frozen=True, eq=False)
class Covariance:
    """What the observations leave open, relative to the fixed camera and with the scale of the scene as it is."""

    joint: Array  # (6 C, 6 C) of the cameras' rotation vectors (radians) and translations, world to camera
    log_focals: Array  # (G,) variances

    @property
    def cameras(self) -> Array:
        """(C, 6, 6) the blocks of the single cameras."""
        count = len(self.joint) // 6
        return np.stack([self.joint[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] for c in range(count)])


def covariance(problem: Problem, prior: LensPrior, config: Config, fixed_camera: int = 0) -> Covariance:
    """Inverse of the normal equations at the minimum, times the variance `config.noise_px ** 2` of an observation."""
    problem = _by_point(problem)
    native, _arrays = _native(problem, prior, config, fixed_camera)
    count, num_lenses = len(problem.rotations), len(problem.log_focals)
    information = np.empty((6 * count + 4 * num_lenses,) * 2)
    library().core_bundle_information(ctypes.byref(native), pointer(information))
    free = np.ones(len(information), bool)
    free[6 * fixed_camera : 6 * fixed_camera + 6] = False
    of_lens = np.stack([prior.sigmas, prior.radial_sigmas, prior.shift_sigmas, prior.shift_sigmas], 1)
    free[6 * count :] = of_lens.ravel() > 0
    seen = np.bincount(problem.camera_of, minlength=count) > 0
    free[: 6 * count] &= np.repeat(seen, 6)
    (kept,) = np.nonzero(free)
    # Parameters differ in unit: they are scaled to equal curvature. The scale of the scene is free; it is held.
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information)[kept], 1e-30))
    free_scale = _growth_of_scene(problem, fixed_camera)[kept] / unit
    free_scale /= max(float(np.linalg.norm(free_scale)), 1e-30)
    held = np.outer(free_scale, free_scale)
    values, vectors = np.linalg.eigh(information[np.ix_(kept, kept)] * unit[:, None] * unit + len(kept) * held)
    inverse = (vectors / np.maximum(values, 1e-14)) @ vectors.T - held / len(kept)
    full = np.zeros_like(information)
    full[np.ix_(kept, kept)] = inverse * unit[:, None] * unit * config.noise_px**2
    return Covariance(
        joint=full[: 6 * count, : 6 * count],
        log_focals=np.diag(full)[6 * count :: 4],
    )


def _growth_of_scene(problem: Problem, fixed_camera: int) -> Array:
    """(6 C + 4 G,) how the parameters change when the scene grows around the fixed camera: no observation does."""
    rotations, translations = problem.rotations, problem.translations
    fixed_centre = -rotations[fixed_camera].T @ translations[fixed_camera]
    poses = np.zeros((len(rotations), 6))
    poses[:, 3:] = translations + rotations @ fixed_centre
    return np.concatenate([poses.ravel(), np.zeros(4 * len(problem.log_focals))])


def _by_point(problem: Problem) -> Problem:
    """The same problem with its observations ordered by point."""
    if (np.diff(problem.point_of) >= 0).all():
        return problem
    order = np.argsort(problem.point_of, kind="stable")
    return replace(
        problem,
        camera_of=problem.camera_of[order],
        point_of=problem.point_of[order],
        pixels=problem.pixels[order],
    )


def _copy(problem: Problem) -> Problem:
    """The problem with parameters that may be changed in place."""
    return replace(
        problem,
        **{
            name: np.array(getattr(problem, name), dtype=np.float64, order="C")
            for name in ("rotations", "translations", "log_focals", "radials", "shifts", "points")
        },
    )


class _Native(ctypes.Structure):
    """`Bundle` of recon/core/bundle.cpp."""

    _fields_ = (
        *(
            (name, ctypes.c_void_p)
            for name in ("rotations", "translations", "log_focals", "radials", "shifts", "points")
        ),
        *((name, ctypes.c_void_p) for name in ("lens_of_camera", "camera_of", "first_of_point", "pixels")),
        *((name, ctypes.c_void_p) for name in ("prior_log_focals", "prior_sigmas", "radial_sigmas", "shift_sigmas")),
        *((name, ctypes.c_int32) for name in ("num_cameras", "num_lenses", "num_points", "fixed_camera")),
        ("robust_squared", ctypes.c_double),
    )


def _native(
    problem: Problem, prior: LensPrior, config: Config, fixed_camera: int
) -> tuple[_Native, list[npt.NDArray[np.generic]]]:
    """The problem as the core reads it, and the arrays that must live as long."""
    first = np.searchsorted(problem.point_of, np.arange(len(problem.points) + 1))
    lenses = (problem.log_focals, problem.radials, problem.shifts)
    parameters = (problem.rotations, problem.translations, *lenses, problem.points)
    indices = (problem.lens_of_camera, problem.camera_of, first)
    sigmas = (
        prior.sigmas / config.noise_px,
        prior.radial_sigmas / config.noise_px,
        prior.shift_sigmas / config.noise_px,
    )
    observed = (problem.pixels, prior.log_focals, *sigmas)
    arrays: list[npt.NDArray[np.generic]] = [
        *(np.ascontiguousarray(values, dtype=np.float64) for values in parameters),
        *(np.ascontiguousarray(values, dtype=np.int32) for values in indices),
        *(np.ascontiguousarray(values, dtype=np.float64) for values in observed),
    ]
    native = _Native(
        *(pointer(array) for array in arrays),
        len(problem.rotations), len(problem.log_focals), len(problem.points), fixed_camera, config.robust_px**2,
    )  # fmt: skip
    return native, arrays


def _safe_depth(depth: Array) -> Array:
    return np.where(np.abs(depth) < 1e-9, 1e-9, depth)


def cross_matrix(vectors: Array) -> Array:
    """(M, 3, 3) matrices with cross_matrix(v) @ x = v x x."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
