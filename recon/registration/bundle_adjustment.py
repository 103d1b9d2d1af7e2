"""Bundle adjustment for few views: Levenberg-Marquardt on robust reprojection errors (Triggs et al., 2000).

The Schur complement eliminates the points. recon/core/bundle.cpp does the work, in a few milliseconds an iteration, so
that many hypotheses can be tried. An own bundle adjustment gives what few views need: priors on the lens, and the
covariance.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, pointer
from splatnode.recon.geometry import cross_matrix, distortion, undistort_rays

# What ties cameras that took their images together in the bundle adjustment: a pose a frame set, a mount a camera.

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_FIXED = -1.0  # in place of the information of a mount that is the rig's own frame


@dataclass(frozen=True, eq=False)
class RigConstraint:
    """The constraint that C cameras stand as their mounts on the rig say: S frame sets and M mounts."""

    set_of_camera: Index  # (C,) -1: this camera is in no frame set
    mount_of_camera: Index  # (C,) -1 likewise
    sigmas: Array  # (C, 2) between camera and rig: of a turn about each axis, radians, and of a shift along each
    set_rotations: Array  # (S, 3, 3) world to rig
    set_translations: Array  # (S, 3)
    mount_rotations: Array  # (M, 3, 3) rig to camera
    mount_translations: Array  # (M, 3)
    is_fixed: npt.NDArray[np.bool_]  # (M,) whether the mount is the rig's own frame
    # (M, 3, 3), (M, 3), (M, 2) of given mounts: rotations, centres in the rig, and sigmas as above; inf: not known
    given_rotations: Array
    given_centres: Array
    given_sigmas: Array

    @property
    def num_sets(self) -> int:
        return len(self.set_rotations)

    @property
    def num_mounts(self) -> int:
        return len(self.mount_rotations)

    @property
    def holds_scale(self) -> bool:
        """Whether given mounts say how long a unit is."""
        return bool(np.isfinite(self.given_sigmas[:, 1]).any())

    def copy(self) -> RigConstraint:
        """Returns it with parameters of its own, which the core changes in place."""
        names = ("set_rotations", "set_translations", "mount_rotations", "mount_translations")
        return replace(self, **{name: np.array(getattr(self, name), dtype=np.float64, order="C") for name in names})

    def relabel(self, old: Index) -> RigConstraint:
        """Camera i is tied as camera `old[i]` was."""
        of = {name: getattr(self, name)[old] for name in ("set_of_camera", "mount_of_camera", "sigmas")}
        return replace(self, **of)

    def pack(self, num_cameras: int, noise_px: float) -> list[npt.NDArray[np.generic]]:
        """Returns the constraint as `Bundle` of recon/core/bundle_cost.h has it, for `num_cameras` cameras."""
        of_set, of_mount, sigmas = self.set_of_camera, self.mount_of_camera, self.sigmas
        if self is NO_RIG:
            of_set = of_mount = np.full(num_cameras, -1)
            sigmas = np.full((num_cameras, 2), np.inf)
        given = noise_px**2 / self.given_sigmas**2
        given[self.is_fixed] = _FIXED
        return [
            *(
                np.ascontiguousarray(each, dtype=np.float64)
                for each in (self.set_rotations, self.set_translations, self.mount_rotations, self.mount_translations)
            ),
            *(np.ascontiguousarray(each, dtype=np.int32) for each in (of_set, of_mount)),
            *(
                np.ascontiguousarray(each, dtype=np.float64)
                for each in (noise_px**2 / sigmas**2, self.given_rotations, self.given_centres, given)
            ),
        ]


_NONE, _NO_ROTATIONS, _NO_POINTS = np.zeros(0, np.int64), np.zeros((0, 3, 3)), np.zeros((0, 3))
_NO_SIGMAS = np.zeros((0, 2))
NO_RIG = RigConstraint(
    _NONE, _NONE, _NO_SIGMAS, _NO_ROTATIONS, _NO_POINTS, _NO_ROTATIONS, _NO_POINTS, np.zeros(0, bool),
    _NO_ROTATIONS, _NO_POINTS, _NO_SIGMAS,
)  # fmt: skip


# Bundle adjustment for few views: Levenberg-Marquardt on robust reprojection errors (Triggs et al., 2000).


_RAYLEIGH_MEDIAN = 1.1774  # median length of a 2D error whose components have sigma 1: sqrt(2 log 2)
_MIN_NOISE_PX = 0.05  # at REFERENCE_SIDE: no observation is believed to be better
# Parameters of a pose (rotation vector, translation) and of a lens: log focal, two radial coefficients, shift of the
# principal point (x, y), log aspect, skew
_POSE, _LENS = 6, 7
_MIN_OWN_SIGMA = 1e-6  # of a lens that shares all of a parameter with others: the prior's covariance must be regular
_MIN_DEPTH = 1e-9  # in the problem's unit of length, in place of 0
_BEHIND_PX = 1e3  # the error that the robust cost counts for a point behind its camera
_MIN_CURVATURE = 1e-30  # in place of 0 for a parameter on which no observation depends
_MIN_EIGENVALUE = 1e-14  # of the information at unit curvature: what is flatter is rounding


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """Poses of C cameras that are known within sigmas: Gaussian priors, which may depend on each other, as by drift."""

    rotations: Array  # (C, 3, 3) world to camera
    centres: Array  # (C, 3) world
    sigmas: Array  # (C, 2) of a turn about each axis, radians, and of a position in each direction; inf: not known
    # (6 C, 6 C) covariance of the errors in the cameras' axes, of each a turn and a shift, in place of `sigmas`, which
    # tell what is known at all; None: each pose is independent of the others
    joint: Array | None = None

    @property
    def covariance(self) -> Array:
        """(6 C, 6 C); 0 where nothing is known."""
        known = np.repeat(self.is_held, _POSE)
        if self.joint is not None:
            return np.where(known[:, None] & known, self.joint, 0.0)
        return np.diag(np.where(known, np.repeat(self.sigmas, 3, axis=1).ravel(), 0.0) ** 2)

    @property
    def information(self) -> Array:
        """(6 C, 6 C) of the poses that hold their cameras; 0 where nothing is known."""
        found = np.zeros((_POSE * len(self.sigmas),) * 2)
        (known,) = np.nonzero(np.repeat(self.is_held, _POSE))
        if self.joint is None:
            found[known, known] = 1.0 / np.repeat(self.sigmas, 3, axis=1).ravel()[known] ** 2
        else:
            found[np.ix_(known, known)] = np.linalg.inv(self.joint[np.ix_(known, known)])
        return found

    @property
    def is_held(self) -> npt.NDArray[np.bool_]:
        """(C,) whether a pose holds its camera."""
        return np.asarray(np.isfinite(self.sigmas).all(1))

    def release(self, cameras: Sequence[int]) -> GivenPoses:
        """Those of these cameras hold nothing any more."""
        sigmas = self.sigmas.copy()
        sigmas[list(cameras)] = np.inf
        return replace(self, sigmas=sigmas)

    def relabel(self, old: Index) -> GivenPoses:
        """Camera i has the pose of camera `old[i]`."""
        rows = (_POSE * np.asarray(old)[:, None] + np.arange(_POSE)).ravel()
        joint = None if self.joint is None else self.joint[np.ix_(rows, rows)]
        return GivenPoses(self.rotations[old], self.centres[old], self.sigmas[old], joint)


@dataclass(frozen=True, eq=False)
class Problem:
    """C cameras, G lenses (each shared by a group of cameras), P points and O observations of them."""

    rotations: Array  # (C, 3, 3) world to camera
    translations: Array  # (C, 3) world to camera
    lens_of_camera: Index  # (C,)
    log_focals: Array  # (G,) log of the focal length in pixels
    radials: Array  # (G, 2) radial coefficients: distorted = undistorted * (1 + k1 r^2 + k2 r^4)
    shifts: Array  # (G, 2) of the principal point, pixels
    points: Array  # (P, 3) world
    camera_of: Index  # (O,)
    point_of: Index  # (O,)
    pixels: Array  # (O, 2) relative to the nominal principal point
    log_aspects: Array | None = None  # (G,) log of the focal length down over that across; None: pixels are square
    skews: Array | None = None  # (G,) how far a row moves across for one down, at depth 1; None: none is sheared
    given: GivenPoses | None = None  # what holds the cameras; None: nothing, so that one of them is fixed
    rig: RigConstraint | None = None  # what ties cameras that took their images together; None: nothing

    @property
    def aspects(self) -> Array:
        """(G,) focal length down over that across."""
        return np.ones(len(self.log_focals)) if self.log_aspects is None else np.exp(self.log_aspects)

    @property
    def all_skews(self) -> Array:
        """(G,) how far a row moves across for one down, at depth 1."""
        return np.zeros(len(self.log_focals)) if self.skews is None else self.skews


class BundleAdjustmentConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bundle adjustment for few views: Levenberg-Marquardt on robust reprojection errors (Triggs et al., 2000)."""

    robust_px: float = 1.0  # scale of the Cauchy loss, pixels
    noise_px: float = 1.0  # standard deviation of an observation, pixels: its weight against the priors
    max_iterations: int = 40
    tolerance: float = 1e-5  # relative decrease of the cost below which it has converged


@dataclass(frozen=True, eq=False)
class CommonLensPrior:
    """The prior that a group's lenses share: each parameter is a common value plus a lens's deviation.

    The sigmas of `LensPrior` then are those of the deviations; the common values have these, around the same means.
    They are eliminated: the prior of a group has the covariance own^2 I + common^2 1 1^T.
    """

    group_of: Index  # (G,)
    # (G, 7) of the common values, equal within a group: log focal, radials, shifts (pixels), log aspect, skew
    sigmas: Array


@dataclass(frozen=True, eq=False)
class LensTies:
    """The ties between lenses: the difference of their parameters has these sigmas around zero."""

    to: Index  # (G,) the lens that each is near; -1: none
    sigmas: Array  # (G, 7) of the differences; 0: this parameter is not tied


@dataclass(frozen=True, eq=False)
class LensPrior:
    """Gaussian priors on the parameters of G lenses; a sigma of 0 fixes the parameter."""

    log_focals: Array  # (G,)
    sigmas: Array  # (G,) of log focal
    radial_sigmas: Array  # (G, 2) around zero
    shift_sigmas: Array  # (G,) pixels around the nominal principal point
    aspect_sigmas: Array | None = None  # (G,) of log aspect around zero; None: fixed
    skew_sigmas: Array | None = None  # (G,) of skew around zero; None: fixed
    common: CommonLensPrior | None = None  # None: each lens is independent of the others, but for `ties`
    ties: LensTies | None = None

    @property
    def means(self) -> Array:
        """(G, 7)"""
        return np.column_stack([self.log_focals, np.zeros((len(self.log_focals), _LENS - 1))])

    @property
    def own_sigmas(self) -> Array:
        """(G, 7)"""
        fixed = np.zeros(len(self.sigmas))
        aspects = fixed if self.aspect_sigmas is None else self.aspect_sigmas
        skews = fixed if self.skew_sigmas is None else self.skew_sigmas
        return np.column_stack([self.sigmas, self.radial_sigmas, self.shift_sigmas, self.shift_sigmas, aspects, skews])

    @property
    def free(self) -> npt.NDArray[np.bool_]:
        """(G, 7) whether a parameter may change."""
        free = self.own_sigmas > 0
        return free if self.common is None else free | (self.common.sigmas > 0)

    @property
    def information(self) -> Array:
        """(7 G, 7 G) the inverse of the prior's covariance; 0 where a parameter is fixed."""
        own, free = self.own_sigmas, self.free
        count = len(own)
        if self.common is None:
            alone = np.diag(np.where(free, 1.0 / np.where(free, own, 1.0) ** 2, 0.0).ravel())
            return alone if self.ties is None else alone + self._tie_information(self.ties, free)
        information = np.zeros((count, _LENS, count, _LENS))
        for group in np.unique(self.common.group_of):
            (members,) = np.nonzero(self.common.group_of == group)
            for k in range(_LENS):
                chosen = members[free[members, k]]
                if len(chosen):
                    weights = np.maximum(own[chosen, k], _MIN_OWN_SIGMA) ** -2.0
                    shared = self.common.sigmas[chosen[0], k] ** 2
                    # The inverse of diag(1 / weights) + shared, which rounding may make singular (Sherman-Morrison)
                    common = shared / (1.0 + shared * weights.sum()) * np.outer(weights, weights)
                    information[chosen[:, None], k, chosen[None], k] = np.diag(weights) - common
        return information.reshape(count * _LENS, count * _LENS)

    @staticmethod
    def _tie_information(ties: LensTies, free: npt.NDArray[np.bool_]) -> Array:
        """(7 G, 7 G); one end of a tie may be fixed."""
        information = np.zeros((free.size, free.size))
        for lens, k in zip(*np.nonzero((ties.to[:, None] >= 0) & (ties.sigmas > 0) & free), strict=True):
            own, other = _LENS * lens + k, _LENS * ties.to[lens] + k
            weight = 1.0 / ties.sigmas[lens, k] ** 2
            information[own, own] += weight
            if free[ties.to[lens], k]:
                information[other, other] += weight
                information[own, other] -= weight
                information[other, own] -= weight
        return information


def make_empty_problem(
    rotations: Array, translations: Array, lens_of_camera: Index, log_focals: Array, radials: Array, shifts: Array
) -> Problem:
    """A problem of cameras and lenses that has no points and observations yet. Shapes as in `Problem`."""
    points, none, pixels = np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros((0, 2))
    return Problem(rotations, translations, lens_of_camera, log_focals, radials, shifts, points, none, none, pixels)


def focal_prior(log_focals: Array, sigmas: Array) -> LensPrior:
    """A prior under which only focal lengths (G,) are free, within `sigmas` (G,)."""
    count = len(log_focals)
    return LensPrior(log_focals, sigmas, np.zeros((count, 2)), np.zeros(count))


def replace_pose(problem: Problem, camera: int, rotation: Array, translation: Array) -> Problem:
    """The problem with another pose of `camera`, world to camera."""
    rotations, translations = problem.rotations.copy(), problem.translations.copy()
    rotations[camera], translations[camera] = rotation, translation
    return replace(problem, rotations=rotations, translations=translations)


def centres(problem: Problem) -> Array:
    """(C, 3) the cameras' centres in the world."""
    return -np.einsum("cji,cj->ci", problem.rotations, problem.translations)


def project(problem: Problem) -> tuple[Array, Array]:
    """Predicted pixels (O, 2) relative to the nominal principal point, and depths (O,) in the cameras."""
    camera, lens = problem.camera_of, problem.lens_of_camera[problem.camera_of]
    in_camera = (
        np.einsum("oij,oj->oi", problem.rotations[camera], problem.points[problem.point_of])
        + problem.translations[camera]
    )
    normalised = in_camera[:, :2] / avoid_zero_depth(in_camera[:, 2:])
    bent = distortion((normalised**2).sum(1), problem.radials[lens])
    sheared = normalised + np.outer(problem.all_skews[lens] * normalised[:, 1], [1.0, 0.0])
    return sheared * _focals(problem, lens) * bent[:, None] + problem.shifts[lens], in_camera[:, 2]


def normalise(problem: Problem, camera: Index, pixels: Array) -> Array:
    """(M, 2) coordinates at depth 1, without distortion, of `pixels` (M, 2) of the cameras `camera` (M,)."""
    lens = problem.lens_of_camera[camera]
    sheared = (pixels - problem.shifts[lens]) / _focals(problem, lens)
    distorted = sheared - np.outer(problem.all_skews[lens] * sheared[:, 1], [1.0, 0.0])
    return undistort_rays(distorted, problem.radials[lens])


def _focals(problem: Problem, lens: Index) -> Array:
    """(M, 2) across and down, pixels, of the lenses (M,)."""
    across = np.exp(problem.log_focals[lens])
    return np.stack([across, across * problem.aspects[lens]], 1)


def reprojection_errors(problem: Problem) -> Array:
    """(O,) pixels; infinite behind the camera."""
    predicted, depth = project(problem)
    return np.where(depth > 0, np.linalg.norm(predicted - problem.pixels, axis=1), np.inf)


def keep_observations(problem: Problem, kept: npt.NDArray[np.bool_]) -> Problem:
    """Returns the problem with the observations `kept` (O,), and the points that at least two of these see."""
    kept = kept & (np.bincount(problem.point_of[kept], minlength=len(problem.points))[problem.point_of] >= 2)
    points, point_of = np.unique(problem.point_of[kept], return_inverse=True)
    return replace(
        problem,
        points=problem.points[points],
        camera_of=problem.camera_of[kept],
        point_of=point_of,
        pixels=problem.pixels[kept],
    )


def robust_cost(problem: Problem, config: BundleAdjustmentConfig) -> float:
    """The Cauchy loss of all observations, pixels squared, without the priors."""
    squared = np.minimum(reprojection_errors(problem), _BEHIND_PX) ** 2
    return float(config.robust_px**2 * np.log1p(squared / config.robust_px**2).sum())


def noise_px(num_observations: int, num_points: int, median_error: float) -> float:
    """The standard deviation of one component of an observation's error, pixels at REFERENCE_SIDE as `median_error` is.

    A point has three parameters, which fit part of the noise: residuals are smaller than errors.
    """
    num_residuals = 2 * num_observations
    shrinkage = np.sqrt(num_residuals / max(1, num_residuals - 3 * num_points))
    return float(max(shrinkage * median_error / _RAYLEIGH_MEDIAN, _MIN_NOISE_PX))


def adjust(problem: Problem, prior: LensPrior, config: BundleAdjustmentConfig, fixed_camera: int = 0) -> Problem:
    """The problem with parameters that minimise robust cost and priors; the pose of `fixed_camera` is fixed."""
    problem = _copy(_sort_by_point(problem))
    native, _arrays = _native(problem, prior, config, fixed_camera)
    core = library()
    core.core_bundle_adjust.restype = ctypes.c_double
    core.core_bundle_adjust(ctypes.byref(native), config.max_iterations, ctypes.c_double(config.tolerance))
    return problem


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the parameters, relative to the fixed camera and with the scale of the scene held."""

    joint: Array  # (6 C, 6 C) of the cameras' rotation vectors (radians) and translations, world to camera
    log_focals: Array  # (G,) variances; 0 where the focal length is fixed
    rig: Array | None = None  # (6 C + 6 M, 6 C + 6 M) of the cameras and the mounts of their rig; None: there is none

    @property
    def cameras(self) -> Array:
        """(C, 6, 6) the blocks of the single cameras."""
        blocks = (slice(start, start + _POSE) for start in range(0, len(self.joint), _POSE))
        return np.stack([self.joint[block, block] for block in blocks])


def covariance(problem: Problem, prior: LensPrior, config: BundleAdjustmentConfig, fixed_camera: int = 0) -> Covariance:
    """Inverse of the normal equations at the minimum, times the variance `config.noise_px ** 2` of an observation.

    It is NaN where the normal equations are not finite. Rounding can make variances negative where the problem is
    nearly singular: `uncertainty.sigmas` takes both for unknown.
    """
    problem = _sort_by_point(problem)
    native, _arrays = _native(problem, prior, config, fixed_camera)
    count, num_lenses = len(problem.rotations), len(problem.log_focals)
    rig = problem.rig or NO_RIG
    num_sets, num_mounts, of_poses = rig.num_sets, rig.num_mounts, _POSE * count + _LENS * num_lenses
    information = np.empty((of_poses + _POSE * (num_sets + num_mounts),) * 2)
    library().core_bundle_information(ctypes.byref(native), pointer(information))
    free = np.ones(len(information), bool)
    observed = np.bincount(problem.camera_of, minlength=count) > 0
    scaled = np.zeros(len(information))
    if problem.rig is not None:
        observed |= problem.rig.set_of_camera >= 0
    if problem.given is None:
        free[_POSE * fixed_camera : _POSE * (fixed_camera + 1)] = False
        scaled = scaled if rig.holds_scale else _scale_direction(problem, fixed_camera)
    else:
        observed |= problem.given.is_held
    free[_POSE * count : of_poses] = prior.free.ravel()
    free[: _POSE * count] &= np.repeat(observed, _POSE)
    free[of_poses + _POSE * num_sets :] = np.repeat(~rig.is_fixed, _POSE)
    (kept,) = np.nonzero(free)
    inverse = _gauge_free_inverse(information[np.ix_(kept, kept)], scaled[kept])
    full = np.zeros_like(information)
    full[np.ix_(kept, kept)] = inverse * config.noise_px**2
    with_rig = np.r_[: _POSE * count, of_poses + _POSE * num_sets : len(full)]
    return Covariance(
        joint=full[: _POSE * count, : _POSE * count],
        log_focals=np.diag(full)[_POSE * count : of_poses : _LENS],
        rig=None if problem.rig is None else full[np.ix_(with_rig, with_rig)],
    )


def _gauge_free_inverse(information: Array, free_direction: Array) -> Array:
    """(M, M) inverse of `information` (M, M), with no variance along `free_direction` (M,); NaN where not finite."""
    # Parameters differ in unit: they are scaled to equal curvature.
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information), _MIN_CURVATURE))
    direction = free_direction / unit
    direction /= max(float(np.linalg.norm(direction)), 1e-30)
    held = np.outer(direction, direction)
    scaled = information * unit[:, None] * unit + len(unit) * held
    if not np.isfinite(scaled).all():
        return np.full_like(information, np.nan)
    values, vectors = np.linalg.eigh(scaled)
    inverse = (vectors / np.maximum(values, _MIN_EIGENVALUE)) @ vectors.T - held / len(unit)
    return inverse * unit[:, None] * unit


def _scale_direction(problem: Problem, fixed_camera: int) -> Array:
    """Returns how the parameters change when the scene is scaled about the fixed camera, which no error sees."""
    fixed_centre = -problem.rotations[fixed_camera].T @ problem.translations[fixed_camera]
    poses = np.zeros((len(problem.rotations), _POSE))
    poses[:, 3:] = problem.translations + problem.rotations @ fixed_centre
    rig = problem.rig or NO_RIG
    sets, mounts = np.zeros((rig.num_sets, _POSE)), np.zeros((rig.num_mounts, _POSE))
    sets[:, 3:], mounts[:, 3:] = rig.set_translations + rig.set_rotations @ fixed_centre, rig.mount_translations
    lenses = np.zeros(_LENS * len(problem.log_focals))
    return np.concatenate([poses.ravel(), lenses, sets.ravel(), mounts.ravel()])


def _sort_by_point(problem: Problem) -> Problem:
    """The same problem with its observations sorted by point, as the core needs them."""
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
    """The problem with copies of its parameters, which the core changes in place."""
    parameters = {
        name: np.array(getattr(problem, name), dtype=np.float64, order="C")
        for name in ("rotations", "translations", "log_focals", "radials", "shifts", "points")
    }
    rig = None if problem.rig is None else problem.rig.copy()
    return replace(problem, **parameters, log_aspects=np.log(problem.aspects), skews=problem.all_skews.copy(), rig=rig)


class _Native(ctypes.Structure):
    """`Bundle` of recon/core/bundle.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("rotations", "translations")),
        *((name, ctypes.c_void_p) for name in ("log_focals", "radials", "shifts", "log_aspects", "skews", "points")),
        *((name, ctypes.c_void_p) for name in ("lens_of_camera", "camera_of", "first_of_point", "pixels")),
        *((name, ctypes.c_void_p) for name in ("prior_means", "prior_information")),
        *((name, ctypes.c_int32) for name in ("num_cameras", "num_lenses", "num_points", "fixed_camera")),
        ("robust_squared", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("given_rotations", "given_centres", "given_information")),
        *((f"{what}_{name}", ctypes.c_void_p) for what in ("set", "mount") for name in ("rotations", "translations")),
        *((name, ctypes.c_void_p) for name in ("set_of_camera", "mount_of_camera", "rig_information")),
        *((f"given_mount_{name}", ctypes.c_void_p) for name in ("rotations", "centres", "information")),
        *((name, ctypes.c_int32) for name in ("num_sets", "num_mounts")),
    )


def _native(
    problem: Problem, prior: LensPrior, config: BundleAdjustmentConfig, fixed_camera: int
) -> tuple[_Native, list[npt.NDArray[np.generic]]]:
    """The problem as the core reads it, and the arrays that it points into, which must live as long."""
    first = np.searchsorted(problem.point_of, np.arange(len(problem.points) + 1))
    log_aspects = np.zeros(len(problem.log_focals)) if problem.log_aspects is None else problem.log_aspects
    lenses = (problem.log_focals, problem.radials, problem.shifts, log_aspects, problem.all_skews)
    parameters = (problem.rotations, problem.translations, *lenses, problem.points)
    indices = (problem.lens_of_camera, problem.camera_of, first)
    observed = (problem.pixels, prior.means, config.noise_px**2 * prior.information)
    arrays: list[npt.NDArray[np.generic]] = [
        *(np.ascontiguousarray(values, dtype=np.float64) for values in parameters),
        *(np.ascontiguousarray(values, dtype=np.int32) for values in indices),
        *(np.ascontiguousarray(values, dtype=np.float64) for values in observed),
    ]
    held, rig = _pack_known_poses(problem, config), problem.rig or NO_RIG
    tied = rig.pack(len(problem.rotations), config.noise_px)
    native = _Native(
        *(pointer(array) for array in arrays),
        len(problem.rotations), len(problem.log_focals), len(problem.points),
        fixed_camera if problem.given is None else -1, config.robust_px**2,
        *(pointer(array) for array in held), *([None] * (3 - len(held))),
        *(pointer(array) for array in tied),
        rig.num_sets, rig.num_mounts,
    )  # fmt: skip
    return native, [*arrays, *held, *tied]


def _pack_known_poses(problem: Problem, config: BundleAdjustmentConfig) -> list[Array]:
    """Rotations, centres and information of the given poses, as the core reads them; none where nothing is given."""
    if problem.given is None:
        return []
    given = problem.given
    values = given.rotations, given.centres, config.noise_px**2 * given.information
    return [np.ascontiguousarray(each, dtype=np.float64) for each in values]


def avoid_zero_depth(depth: Array) -> Array:
    """Depths with _MIN_DEPTH in place of what is nearer to 0, so that they may be divided by."""
    return np.where(np.abs(depth) < _MIN_DEPTH, _MIN_DEPTH, depth)


# Standard deviations of the cameras' poses, in whatever world frame they are given.
#
# Positions are only known up to a similarity, and errors are measured after the best similarity. So is the covariance
# here (an S-transformation: Baarda, 1973): it does not depend on which camera the bundle adjustment fixed. The centres
# of two cameras fix no similarity: there, the orientations say how both are rotated, as where errors are measured.


MIN_FOR_CENTRES = 3  # cameras whose centres alone fix a similarity; those of two leave a turn about their line open
_ROUNDING = 1e-9  # relative error of a variance: a negative one within it is 0, as that of two cameras' distance is
_MIN_SPREAD = 1e-12  # of the centres, in the problem's unit of length, in place of 0
_MIN_SINGULAR = 1e-9  # of the largest singular value: what is smaller is no direction of its own


def sigmas(variances: Array) -> Array:
    """The square roots of `variances`; infinite where one is negative or not finite, which says that nothing is known.

    An infinite sigma fails every limit of the verdict; NaN would pass them.
    """
    known = np.isfinite(variances) & (variances >= 0.0)
    return np.where(known, np.sqrt(np.where(known, variances, 0.0)), np.inf)


def camera_sigmas(problem: Problem, covariance: Covariance, registered: Sequence[int]) -> tuple[Array, Array]:
    """Standard deviations (C,) of the orientations, degrees, and of the centres, relative to their spread.

    In the order of `registered`; each is of the error's three components together. All are infinite where poses or
    covariance are not finite, single ones where their variance is negative beyond rounding.
    """
    errors = _errors(problem, covariance, registered)
    if errors is None:
        return np.full(len(registered), np.inf), np.full(len(registered), np.inf)
    rotation_sigmas, centre_sigmas = (sigmas(_variances(by, errors.joint)) for by in (errors.turns, errors.moves))
    return np.degrees(rotation_sigmas), centre_sigmas / errors.spread


def centre_covariances(problem: Problem, covariance: Covariance, registered: Sequence[int]) -> Array:
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


def _errors(problem: Problem, covariance: Covariance, registered: Sequence[int]) -> _Errors | None:
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
    free = [translated, centred.reshape(-1, 1) / spread]
    if count < MIN_FOR_CENTRES:  # the orientations say how all are rotated
        moves = moves - rotated @ turns.reshape(count, 3, -1).mean(0)
    else:
        free.append(rotated / spread)
    turns = _make_null_projection(translated) @ turns
    return _Errors(joint, turns, _make_null_projection(np.column_stack(free)) @ moves, spread)


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
