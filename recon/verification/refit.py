"""A registration adjusted once more: from another start, from some of its points, or with a lens set free."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import align_cameras, angles_deg, compute_rms_radius, umeyama
from splatnode.recon.keyframes import REFERENCE_SIDE, Keyframe, longer_side
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment, incremental_mapper, multiview_geometry, self_calibration
from splatnode.recon.registration.registration import Registration
from splatnode.recon.registration.self_calibration import CORNER

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

NOMINAL_SIGMA = self_calibration.LensGroupingConfig().exif_sigma
FREE_SIGMA = 0.3  # of log focal where nothing is known: one sigma is a factor of 1.35
FREE_SHIFT = (
    self_calibration.LensGroupingConfig().free_shift_sigma
)  # of the longer side, of a principal point that was displaced
FREE_ASPECT = 0.1  # of log aspect, where pixels are not square
FREE_SKEW = 0.05  # where a picture is sheared
SQUARE = 1e-3  # difference of an aspect from 1, or a skew, from which on they are not
ROBUST_FACTOR = 3.0  # width of the Cauchy loss over the median error
ROBUST_PX = (0.4, 1.5)  # least and most width of the Cauchy loss, pixels at REFERENCE_SIDE
MIN_COST = 1e-12  # pixels squared: a smaller cost counts as this one where ratios are taken; made-up data have none
MIN_SPREAD = 1e-12  # of centres, as MIN_COST: all in one place


@dataclass(frozen=True, eq=False)
class BundleFit:
    """A bundle that holds C registered cameras, numbered in their order, with what is known of their lenses."""

    problem: bundle_adjustment.Problem
    prior: bundle_adjustment.LensPrior
    loss: bundle_adjustment.BundleAdjustmentConfig
    scale: float  # longer side of the largest frame, whose pixels these are, over REFERENCE_SIDE
    given_focals: Array  # (G,) focal length that came with the frames; NaN where none did
    nominal_sigmas: Array  # (G,) of its logarithm where it is nominal, as EXIF's is; infinite for any other lens
    own: npt.NDArray[np.bool_]  # (G,) lenses of single images, which refute the one that they were taken to share
    units: Array  # (G,) pixels of the largest frame of each lens over those of the largest of all

    @property
    def Ts_world_camera(self) -> Array:
        """(C, 4, 4)"""
        return Ts_world_camera(self.problem)

    @cached_property
    def minimum(self) -> BundleFit:
        """This fit adjusted: found once, for several sources of evidence begin there."""
        return replace(self, problem=bundle_adjustment.adjust(self.problem, self.prior, self.loss))

    @cached_property
    def apart(self) -> BundleFit:
        """This fit adjusted with a lens for each camera, under wide priors."""
        whole = self.minimum
        return replace(whole, problem=_doubt_lenses(whole, FARTHEST_SHIFT)[0])

    @property
    def cost(self) -> float:
        """Robust cost of an observation, pixels squared; NaN where a camera or a lens is no longer a number.

        The bundle counts an observation without a depth as one behind its camera, and would hide that.
        """
        lenses = (self.problem.log_focals, self.problem.radials, self.problem.shifts)
        if not all(np.isfinite(known).all() for known in (self.Ts_world_camera, *lenses)):
            return np.nan
        return bundle_adjustment.robust_cost(self.problem, self.loss) / max(1, len(self.problem.pixels))


def build_fit(keyframes: Sequence[Keyframe], registration: Registration, tracks_per_camera: int) -> BundleFit:
    """The registration as a bundle of at most about `tracks_per_camera` tracks a camera, the longest first.

    A given focal length is kept, others are almost free. Pixels are those of frames enlarged to the largest of all.
    """
    cameras = registration.cameras
    position = np.full(len(keyframes), -1)
    position[[camera.index for camera in cameras]] = np.arange(len(cameras))
    camera_of = position[registration.observed_by]
    chosen = multiview_geometry.longest(
        camera_of, registration.observed_point, len(registration.points), tracks_per_camera
    )
    observed = chosen[registration.observed_point]
    sides = np.array([longer_side(keyframes[c.index].frame) for c in cameras])
    numbers, lens_of_camera = np.unique([camera.lens for camera in cameras], return_inverse=True)
    count, largest = len(numbers), sides.max()
    units = np.array([sides[lens_of_camera == lens].max() for lens in range(count)]) / largest
    enlarged = largest / sides
    focals, aspects, skews, sigmas = (np.zeros(count) for _ in range(4))
    radials, skew_sigmas = np.zeros((count, 2)), np.zeros(count)
    given_focals, nominal = np.full(count, np.nan), np.full(count, np.inf)
    shift_sigmas, aspect_sigmas, own = np.zeros(count), np.zeros(count), np.zeros(count, bool)
    near = np.full(count, -1)
    for camera, lens, by in zip(cameras, lens_of_camera, enlarged, strict=True):
        given = None if camera.own_lens else keyframes[camera.index].frame.intrinsics
        focals[lens], aspects[lens], radials[lens] = by * camera.focal, camera.aspect, camera.radial
        given_focals[lens] = np.nan if given is None else by * given.fx
        calibrated = given is not None and given.source in ("given", "calibration")
        sigmas[lens] = 0.0 if calibrated else FREE_SIGMA
        nominal[lens] = np.inf if given is None or calibrated else NOMINAL_SIGMA
        shift_sigmas[lens] = FREE_SHIFT * largest if camera.displaced else 0.0
        stretched = abs(camera.aspect - 1.0) > SQUARE
        aspect_sigmas[lens] = max(FREE_ASPECT, abs(np.log(camera.aspect))) if stretched else 0.0
        skews[lens] = camera.skew
        skew_sigmas[lens] = max(FREE_SKEW, abs(camera.skew)) if abs(camera.skew) > SQUARE else 0.0
        own[lens], near[lens] = camera.own_lens, camera.near_lens
    principal = np.stack([camera.principal for camera in cameras])
    Ts_camera_world: Array = np.linalg.inv(np.stack([camera.T_world_camera for camera in cameras])).astype(np.float64)
    (kept,) = np.nonzero(chosen)
    problem = bundle_adjustment.Problem(
        rotations=Ts_camera_world[:, :3, :3],
        translations=Ts_camera_world[:, :3, 3],
        lens_of_camera=lens_of_camera,
        log_focals=np.log(focals),
        radials=radials,
        shifts=np.zeros((count, 2)),
        points=registration.points[kept],
        camera_of=camera_of[observed],
        point_of=np.searchsorted(kept, registration.observed_point[observed]),
        pixels=(enlarged[camera_of, None] * (registration.observed_pixels - principal[camera_of]))[observed],
        log_aspects=np.log(aspects),
        skews=skews,
    )
    scale = float(largest) / REFERENCE_SIDE
    is_nominal = np.isfinite(nominal)
    means = np.where(is_nominal, np.log(np.where(is_nominal, given_focals, 1.0)), problem.log_focals)
    prior = bundle_adjustment.LensPrior(
        log_focals=means,
        sigmas=np.minimum(sigmas, nominal),
        radial_sigmas=np.zeros((count, 2)),
        shift_sigmas=shift_sigmas,
        aspect_sigmas=aspect_sigmas,
        skew_sigmas=skew_sigmas,
        ties=_tie_near_lenses(numbers, near),
    )
    errors = bundle_adjustment.reprojection_errors(problem)
    median = float(np.median(errors))
    robust_px = float(np.clip(ROBUST_FACTOR * median, *(np.array(ROBUST_PX) * scale)))
    noise = bundle_adjustment.noise_px(len(problem.pixels), len(problem.points), median / scale)
    loss = bundle_adjustment.BundleAdjustmentConfig(
        robust_px=robust_px,
        noise_px=scale * noise * float(np.sqrt(incremental_mapper.FinalAdjustmentConfig().correlated)),
    )
    return BundleFit(problem, prior, loss, scale, given_focals, nominal, own, units)


def _tie_near_lenses(numbers: Index, near: Index) -> bundle_adjustment.LensTies | None:
    """Ties the focal lengths of lenses that are near one lens to that one, or to the first of them."""
    to, sigmas = np.full(len(numbers), -1), np.zeros((len(numbers), 7))
    for common in np.unique(near[near >= 0]):
        (members,) = np.nonzero(near == common)
        (itself,) = np.nonzero(numbers == common)
        first = itself[0] if len(itself) else members[0]
        others = members[members != first]
        to[others], sigmas[others, 0] = first, self_calibration.OwnLensesConfig().focal_sigma
    return bundle_adjustment.LensTies(to, sigmas) if (to >= 0).any() else None


def compute_nominal_cost(of: BundleFit) -> float:
    """Returns how far nominal focal lengths are from those of the fit: squares of standard errors.

    All EXIF data of a camera err together: each lens counts as a share of one observation.
    """
    known = np.isfinite(of.nominal_sigmas)
    if not known.any():
        return 0.0
    off = (of.problem.log_focals - np.log(np.where(known, of.given_focals, 1.0))) / of.nominal_sigmas
    return float(np.mean(off[known] ** 2))


def adjust(start: BundleFit) -> BundleFit:
    return start.minimum


def estimate_noise_px(of: BundleFit) -> float:
    """The standard deviation of one component of an observation's error, pixels of the largest frame; never 0."""
    median = float(np.median(bundle_adjustment.reprojection_errors(of.problem))) / of.scale
    return of.scale * bundle_adjustment.noise_px(len(of.problem.pixels), len(of.problem.points), median)


def remove_points(start: BundleFit, left_out: npt.NDArray[np.bool_]) -> BundleFit:
    """The same with the points `left_out` (P,) taken away."""
    problem = start.problem
    (kept,) = np.nonzero(~left_out)
    observed = ~left_out[problem.point_of]
    smaller = replace(
        problem,
        points=problem.points[kept],
        camera_of=problem.camera_of[observed],
        point_of=np.searchsorted(kept, problem.point_of[observed]),
        pixels=problem.pixels[observed],
    )
    return replace(start, problem=smaller)


def Ts_world_camera(problem: bundle_adjustment.Problem) -> Array:
    """(C, 4, 4) of a bundle's cameras."""
    Ts = np.tile(np.eye(4), (len(problem.rotations), 1, 1))
    Ts[:, :3, :3] = problem.rotations.transpose(0, 2, 1)
    Ts[:, :3, 3] = -np.einsum("cji,cj->ci", problem.rotations, problem.translations)
    return Ts


@dataclass(frozen=True)
class FitShift:
    """How far cameras have moved from one fit to another."""

    rotation_deg: float  # the largest change of a relative rotation
    centre_rel: float  # RMS change of the centres after the best similarity, relative to their spread
    focal_rel: float  # the largest change of a focal length, of its logarithm


@dataclass(frozen=True, eq=False)
class CameraShifts:
    """How far each camera has moved from one fit to another."""

    rotation_deg: Array  # (C,) after the best common rotation
    centre: Array  # (C,) after the best similarity, in the unit of the first fit
    focals_rel: Array  # (G,) change of the logarithm of each lens' focal length, without its sign


def compute_camera_shifts(before: BundleFit, after: BundleFit) -> CameraShifts:
    """Farther than any limit, and finite, where one of the two has come to nothing."""
    Ts_before, Ts_after = before.Ts_world_camera, after.Ts_world_camera
    count = len(Ts_before)
    if not (np.isfinite(Ts_before).all() and np.isfinite(Ts_after).all()):
        lost = np.full(len(before.problem.log_focals), LOST.focal_rel)
        return CameraShifts(np.full(count, LOST.rotation_deg), np.full(count, LOST.centre_rel), lost)
    common = align_cameras(Ts_after, Ts_before)
    centres, target = Ts_after[:, :3, 3], Ts_before[:, :3, 3]
    onto = umeyama(centres, target) if count >= bundle_adjustment.MIN_FOR_CENTRES else common
    return CameraShifts(
        rotation_deg=angles_deg(common.rotation @ Ts_after[:, :3, :3], Ts_before[:, :3, :3]),
        centre=np.linalg.norm(onto(centres) - target, axis=1),
        focals_rel=np.abs(before.problem.log_focals - after.problem.log_focals),
    )


LOST = FitShift(rotation_deg=180.0, centre_rel=1e3, focal_rel=10.0)  # farther than any limit, and finite


def compute_shift(before: BundleFit, after: BundleFit) -> FitShift:
    """`LOST` where one of them has come to nothing."""
    Ts_before, Ts_after = before.Ts_world_camera, after.Ts_world_camera
    if not (np.isfinite(Ts_before).all() and np.isfinite(Ts_after).all()):
        return LOST
    first, second = np.triu_indices(len(Ts_before), 1)
    relative = [Ts[first, :3, :3].transpose(0, 2, 1) @ Ts[second, :3, :3] for Ts in (Ts_before, Ts_after)]
    moved = align_cameras(Ts_after, Ts_before)
    centres = moved(Ts_after[:, :3, 3])
    target = Ts_before[:, :3, 3]
    return FitShift(
        rotation_deg=float(angles_deg(*relative).max()),
        centre_rel=float(
            np.sqrt(((centres - target) ** 2).sum(1).mean()) / max(compute_rms_radius(target), MIN_SPREAD)
        ),
        focal_rel=float(np.abs(before.problem.log_focals - after.problem.log_focals).max()),
    )


# What the focal length leaves open: the profile of the cost over it, and how far the cameras move along it.
#
# Where all cameras look the same way, or turn about what they see, depth and focal length trade against each other
# (the bas-relief ambiguity: Belhumeur et al. 1999), and the cost is no parabola: the covariance at its minimum says
# too little. Here the focal length is held at steps beside its best value, and all else is adjusted anew.


PROFILE_STEPS = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)  # of log focal, either way; the last is a factor of 1.9
# Rise of the cost, in units of the variance of an observation, that counts as one standard error. Observations err
# together: so many of them tell as much as one with an error of its own, as in registration's covariance. What EXIF
# says of the focal length is one observation more.
ONE_SIGMA = incremental_mapper.FinalAdjustmentConfig().correlated


@dataclass(frozen=True)
class FocalProfile:
    """The interval of one standard error, and the most that the cameras move within it."""

    # Of each lens: the wider side of the interval, of log focal; the last step where the cost never rises so far
    focal_rel: tuple[float, ...]
    rotation_deg: tuple[float, ...]  # of each camera, after the best common rotation
    centre: tuple[float, ...]  # of each camera, after the best similarity, in the unit of the world


@dataclass(frozen=True, eq=False)
class _ProfileStep:
    """All is relative to the best fit."""

    focal_rel: float
    sigmas: float  # the root of the rise of the cost, in standard errors
    moved: CameraShifts


def profile_focal(fit: BundleFit) -> FocalProfile:
    """Profiles the lenses that are not calibrated, all changed by one factor; all 0 where every lens is.

    NaN where the fit has come to nothing.
    """
    whole = adjust(fit)
    count = len(whole.problem.rotations)
    if not np.isfinite(whole.cost):
        return FocalProfile((np.nan,) * len(whole.prior.sigmas), (np.nan,) * count, (np.nan,) * count)
    free = (whole.prior.sigmas > 0).astype(np.float64)
    ends = [_find_interval_end(whole, direction) for direction in (free, -free)] if free.any() else []
    still = np.zeros(count)
    return FocalProfile(
        focal_rel=tuple((max((end.focal_rel for end in ends), default=0.0) * free).tolist()),
        rotation_deg=tuple(np.max([still, *(end.moved.rotation_deg for end in ends)], axis=0).tolist()),
        centre=tuple(np.max([still, *(end.moved.centre for end in ends)], axis=0).tolist()),
    )


def _find_interval_end(whole: BundleFit, direction: Array) -> _ProfileStep:
    """One end of the interval: between the last step within it and the first beyond, both moved alike."""
    count = len(whole.problem.rotations)
    before = _ProfileStep(0.0, 0.0, CameraShifts(np.zeros(count), np.zeros(count), np.zeros(len(direction))))
    for step in _compute_steps(whole, direction):
        if step.sigmas >= 1.0:
            share = (1.0 - before.sigmas) / max(step.sigmas - before.sigmas, MIN_COST)
            return _interpolate_step(before, step, share)
        before = _ProfileStep(step.focal_rel, step.sigmas, _combine_farthest(before.moved, step.moved))
    return before


def _compute_steps(whole: BundleFit, direction: Array) -> Iterator[_ProfileStep]:
    noise2 = estimate_noise_px(whole) ** 2
    held = replace(whole, prior=replace(whole.prior, sigmas=np.zeros_like(whole.prior.sigmas)))
    for size in PROFILE_STEPS:
        log_focals = whole.problem.log_focals + size * direction
        held = adjust(replace(held, problem=replace(held.problem, log_focals=log_focals)))
        rise = (held.cost - whole.cost) * len(whole.problem.pixels) / noise2 / ONE_SIGMA
        rise += compute_nominal_cost(held) - compute_nominal_cost(whole)
        yield _ProfileStep(size, float(np.sqrt(np.maximum(rise, 0.0))), compute_camera_shifts(whole, held))


def _interpolate_step(before: _ProfileStep, after: _ProfileStep, share: float) -> _ProfileStep:
    """A step that lies `share` of the way from one to the other."""

    def interpolate(one: Array, other: Array) -> Array:
        return one + share * (other - one)

    moved = CameraShifts(
        interpolate(before.moved.rotation_deg, after.moved.rotation_deg),
        interpolate(before.moved.centre, after.moved.centre),
        interpolate(before.moved.focals_rel, after.moved.focals_rel),
    )
    return _ProfileStep(before.focal_rel + share * (after.focal_rel - before.focal_rel), 1.0, moved)


def _combine_farthest(one: CameraShifts, other: CameraShifts) -> CameraShifts:
    return CameraShifts(
        np.maximum(one.rotation_deg, other.rotation_deg),
        np.maximum(one.centre, other.centre),
        np.maximum(one.focals_rel, other.focals_rel),
    )


# How much the answer depends on single parts of the pictures: it is found again without each of them.


GROUPS = 4  # in which the points are divided, each way: the quarters of a picture


@dataclass(frozen=True)
class JackknifeSpread:
    """Standard errors by the delete-a-group jackknife (Efron 1982), the points grouped by where they are.

    Neighbours err together: by distortion that is not modelled, by things that moved, by wrong matches of a structure
    that repeats. The covariance takes errors for independent and is several times too small; leaving out whole regions
    lets them show.
    """

    rotation_deg: tuple[float, ...]  # of each camera, after the best common rotation
    centre: tuple[float, ...]  # of each camera, after the best similarity, in the unit of the world
    focal_rel: tuple[float, ...]  # of the logarithm of each lens' focal length


def estimate_spread(fit: BundleFit) -> JackknifeSpread:
    """The spread when quarters of the points are left out: columns, rows, corners and depths in turn."""
    whole = adjust(fit)
    rotations, centres, focals = [], [], []
    for groups in _group_points(fit.problem):
        moved = [compute_camera_shifts(whole, adjust(remove_points(whole, groups == group))) for group in range(GROUPS)]
        rotations.append(_compute_variance([each.rotation_deg for each in moved]))
        centres.append(_compute_variance([each.centre for each in moved]))
        focals.append(_compute_variance([each.focals_rel for each in moved]))
    return JackknifeSpread(
        rotation_deg=tuple(np.sqrt(np.mean(rotations, axis=0)).tolist()),
        centre=tuple(np.sqrt(np.mean(centres, axis=0)).tolist()),
        focal_rel=tuple(np.sqrt(np.mean(focals, axis=0)).tolist()),
    )


def _compute_variance(changes: Sequence[Array]) -> Array:
    """(C,) of what leaving out one group after the other changes."""
    return np.square(changes).sum(0) * (GROUPS - 1) / GROUPS


def _group_points(problem: bundle_adjustment.Problem) -> Iterator[npt.NDArray[np.int64]]:
    """(P,) groups, by the picture in which a point is seen first."""
    first = np.full(len(problem.points), -1)
    order = np.arange(len(problem.pixels))[::-1]
    first[problem.point_of[order]] = order
    pixels, camera = problem.pixels[first], problem.camera_of[first]
    depths = np.einsum("pi,pi->p", problem.rotations[camera, 2], problem.points) + problem.translations[camera, 2]
    yield _assign_quarters(pixels[:, 0])
    yield _assign_quarters(pixels[:, 1])
    yield 2 * (pixels[:, 0] > np.median(pixels[:, 0])) + (pixels[:, 1] > np.median(pixels[:, 1]))
    yield _assign_quarters(depths)


def _assign_quarters(values: Array) -> npt.NDArray[np.int64]:
    """(P,) in which quarter of `values` (P,) each of them is."""
    return GROUPS * np.argsort(np.argsort(values)) // max(1, len(values))


# Given focal lengths doubted: what the pictures themselves say when the lens is set free.

FREE_RADIAL = 0.3  # sigma of the first radial coefficient where it is free
FREED_LENS_STEPS = (0.0, 0.35, -0.35)  # of log focal, from which it is set free: a wrong one can be a local minimum


@dataclass(frozen=True)
class FreedLens:
    """A lens whose focal length came with the frames, after the same observations were adjusted with it free."""

    given: float  # pixels of the full-size image
    trusted: bool  # a calibration; else nominal, as from EXIF
    registered: float  # where the registration left it: a nominal one may move a little
    found: float
    cost_ratio: float  # robust cost with the lens free over that with it as it was registered


@dataclass(frozen=True)
class Distortion:
    """The distortion that the observations ask for when all first radial coefficients are free, too."""

    corner_shift: float  # by which a corner of the picture moves further, relative to its distance from the middle
    cost_ratio: float  # robust cost with it free over that with it as registered


def measure_distortion(fit: BundleFit) -> Distortion:
    held = adjust(fit)
    num_lenses = len(held.prior.sigmas)
    first = np.tile([FREE_RADIAL, 0.0], (num_lenses, 1))
    free = adjust(replace(held, prior=replace(held.prior, radial_sigmas=first)))
    corner = CORNER * REFERENCE_SIDE * held.scale
    further = (free.problem.radials - held.problem.radials)[:, 0] * (corner / np.exp(free.problem.log_focals)) ** 2
    return Distortion(float(np.abs(further).max()), float(free.cost / max(held.cost, MIN_COST)))


def free_lenses(fit: BundleFit) -> tuple[FreedLens, ...]:
    """All lenses that came with the frames, set free together. Empty where none did."""
    is_given = np.isfinite(fit.given_focals)
    if not is_given.any():
        return ()
    held = adjust(replace(fit, prior=replace(fit.prior, sigmas=np.where(is_given, 0.0, fit.prior.sigmas))))
    prior = replace(held.prior, sigmas=np.where(is_given, FREE_SIGMA, held.prior.sigmas))
    starts = [held.problem.log_focals + np.where(is_given, step, 0.0) for step in FREED_LENS_STEPS]
    tried = [adjust(replace(held, prior=prior, problem=replace(held.problem, log_focals=s))) for s in starts]
    free = tried[int(np.argmin([candidate.cost for candidate in tried]))]  # the first NaN, where there is one
    ratio = float(free.cost / max(held.cost, MIN_COST))
    focals = (fit.given_focals, np.exp(held.problem.log_focals), np.exp(free.problem.log_focals))
    given, registered, found = ((fit.units * each).tolist() for each in focals)
    return tuple(
        FreedLens(given[g], bool(fit.prior.sigmas[g] == 0), registered[g], found[g], ratio)
        for g in np.nonzero(is_given)[0]
    )


def vote_focal(keyframes: Sequence[Keyframe], pairs: Sequence[TwoView]) -> float | None:
    """The focal length in pixels that the pairs vote for where all frames have the same size, else None."""
    sides = {longer_side(keyframe.frame) for keyframe in keyframes}
    if len(sides) != 1 or not pairs:
        return None
    return self_calibration.vote(pairs, num_candidates=1)[0] * sides.pop()


# What unknown principal points leave open: pictures of another size may be crops, with the lens beside their middle.
#
# A picture that was cut out of a larger one fits nearly as well with its lens behind the middle, from a wrong pose.
# Among pictures of one size and one lens that would show; of one that differs from the others it would not. There the
# principal point is set free, and how far that moves the cameras is how wrong they may be.

FREE_PRINCIPAL_SHIFT = (
    self_calibration.LensGroupingConfig().free_shift_sigma
)  # of the longer side, as where frames of several sizes are told apart


def free_principal_points(fit: BundleFit) -> CameraShifts | None:
    """How far the cameras move when the lenses of fewer cameras than the commonest one are set free.

    None where all pictures came through one lens, or every other one came calibrated. Lenses of single images that
    refuted the common one are left out: where their principal points are was asked when they were found.
    """
    count = len(fit.prior.sigmas)
    seen_through = np.bincount(fit.problem.lens_of_camera, minlength=count)
    free = (fit.prior.sigmas > 0) & ~fit.own & (np.arange(count) != seen_through.argmax())
    if not free.any():
        return None
    whole = adjust(fit)
    sigmas = np.where(free, FREE_PRINCIPAL_SHIFT * REFERENCE_SIDE * max(fit.scale, 1.0), whole.prior.shift_sigmas)
    return compute_camera_shifts(whole, adjust(replace(whole, prior=replace(whole.prior, shift_sigmas=sigmas))))


# What lenses may differ in without showing it: focal lengths of images, principal points of groups, all adjusted anew.
#
# A zoom of a few percent, an autofocus that breathes or a second camera shows only where a scene has depth: what lies
# at one distance looks the same from farther away through a longer lens. Crops and keystone corrections displace the
# principal points of all images alike, which looks nearly like a turn. `own_lenses` gives images other lenses only
# where the observations refute the common one. Where they leave it open, the cameras may be as far off as they would
# move with such lenses.

DOUBTED_FOCAL = 0.1  # sigma of log focal by which an image's lens may differ from the common one
DOUBTED_ASPECT = 0.003  # sigma of the log aspect by which an image may differ from the common one
DOUBTED_SKEW = 0.001  # sigma of the skew of an image
DOUBTED_SHIFT = 0.1  # sigma of the common principal point, of the longer side
# The same where observations may ask for it themselves: keystone corrections of long lenses shift by as much
FARTHEST_SHIFT = 0.3
ASKED_WEIGHT = 1.5  # of what observations ask for, beside what they leave open


def doubt_common_lenses(fit: BundleFit) -> CameraShifts:
    """How far off cameras may be if their lenses are not what they were taken for: RMS over such cameras.

    The mean of these cameras is where an adjustment finds them under wide priors, and counts ASKED_WEIGHT times; their
    spread is the covariance under the usual ones. The focal lengths are those of the cameras (C,), and not of their
    lenses. A camera that shares its lens with no other keeps its prior, unless its image refuted a shared one: then it
    may be a crop.
    """
    whole = adjust(fit)
    usual, prior = _doubt_lenses(whole, DOUBTED_SHIFT)
    covariance = bundle_adjustment.covariance(usual, prior, fit.loss, 0)
    mean = compute_camera_shifts(replace(whole, problem=self_calibration.expand_lenses(whole.problem)), fit.apart)
    rotations, centres = bundle_adjustment.camera_sigmas(usual, covariance, range(len(whole.problem.rotations)))
    return CameraShifts(
        rotation_deg=np.hypot(ASKED_WEIGHT * mean.rotation_deg, rotations),
        centre=np.hypot(ASKED_WEIGHT * mean.centre, compute_rms_radius(whole.Ts_world_camera[:, :3, 3]) * centres),
        focals_rel=np.hypot(ASKED_WEIGHT * mean.focals_rel, bundle_adjustment.sigmas(covariance.log_focals)),
    )


def compute_own_lens_cost(fit: BundleFit) -> float:
    """Returns the robust cost with a lens for each camera over that with the lenses of the fit.

    Right lenses leave others little to explain. What is far below was refuted, though no lens of an image was found.
    """
    return float(fit.apart.cost / max(adjust(fit).cost, MIN_COST))


def _doubt_lenses(
    whole: BundleFit, shift_sigma: float
) -> tuple[bundle_adjustment.Problem, bundle_adjustment.LensPrior]:
    """The bundle adjusted with a lens for each camera, and the prior; `shift_sigma` is of the longer side."""
    count, side = len(whole.problem.rotations), REFERENCE_SIDE * whole.scale
    config = msgspec.structs.replace(
        self_calibration.OwnLensesConfig(),
        focal_sigma=DOUBTED_FOCAL,
        own_aspect_sigma=DOUBTED_ASPECT,
        skew_sigma=DOUBTED_SKEW,
    )
    shared = np.bincount(whole.problem.lens_of_camera, minlength=len(whole.prior.sigmas)) > 1
    shifts = np.maximum(whole.prior.shift_sigmas, np.where(shared | whole.own, shift_sigma * side, 0.0))
    prior = replace(whole.prior, shift_sigmas=shifts)
    apart, prior = self_calibration.widen_lens_priors(whole.problem, prior, np.full(count, side), config)
    return bundle_adjustment.adjust(apart, prior, whole.loss), prior


# The mirrored answer: seen from afar, a scene and its mirror image in depth look the same from mirrored cameras.

# Shifts below which the mirrored start has found its way back to the same answer:
SAME_DEG = 1.0  # of rotations
SAME_REL = 0.03  # of centres, relative to their spread
NO_RIVAL = 100.0  # ratio of costs that stands for the lack of a mirrored answer; far beyond all that counts


def compute_reversal_cost_ratio(fit: BundleFit) -> float:
    """How much worse the mirrored answer is than this one: the ratio of their costs, both adjusted; near 1 nothing
    tells them apart, and 100 at most. NaN where one of the two could not be computed.

    Under an affine camera, points mirrored in a plane that faces the camera and cameras turned the other way give the
    same pictures (Necker's reversal; Shapiro et al. 1995). Perspective breaks the tie, if there is enough of it.
    """
    whole = adjust(fit)
    other = adjust(replace(whole, problem=_reverse_depth(whole.problem)))
    between = compute_shift(whole, other)
    if between.rotation_deg < SAME_DEG and between.centre_rel < SAME_REL:
        return NO_RIVAL
    return float(np.minimum(NO_RIVAL, other.cost / np.maximum(whole.cost, MIN_COST)))


def _reverse_depth(problem: bundle_adjustment.Problem) -> bundle_adjustment.Problem:
    """The problem with its points mirrored in the plane through their middle that faces the first camera."""
    rotation0, translation0 = problem.rotations[0], problem.translations[0]
    points = problem.points @ rotation0.T + translation0
    rotations = problem.rotations @ rotation0.T
    translations = problem.translations - rotations @ translation0
    middle = np.median(points, axis=0)
    mirror = np.diag([1.0, 1.0, -1.0])
    turned = mirror @ rotations @ mirror
    return replace(
        problem,
        rotations=turned,
        translations=rotations @ middle + translations - turned @ middle,
        points=(points - middle) @ mirror + middle,
    )


# How large the errors of cameras may be: what three sources say, each of which is blind to something.

# Aligned patches make sigmas smaller, but not the part that is of lenses, which may differ from image to image
LEAST_SHARPER = 0.5
MIN_SIGMA = 1e-9  # a smaller one counts as this where ratios are taken


@dataclass(frozen=True)
class Errors:
    """The size of one error as each source says it, as one standard error."""

    sigma: float  # the covariance of the bundle adjustment, which takes errors for independent
    regions: float  # what leaving out regions of the pictures changes (a jackknife, above)
    profile: float  # what unknown lenses leave open (focal profile and principal point, above)
    lenses: float = 0.0  # what other lenses than those taken for granted leave open (above)


@dataclass(frozen=True)
class PoseErrors:
    """The errors of the pose of one camera."""

    rotation: Errors  # degrees, after the best common rotation
    centre: Errors  # after the best similarity; the distance to the scene is 1


@dataclass(frozen=True)
class AllErrors:
    cameras: Mapping[int, PoseErrors]  # by their keyframes' positions
    focals: Mapping[int, Errors]  # of the logarithms of their focal lengths, likewise

    @property
    def focal(self) -> Errors:
        """Returns the errors of the least certain focal length, by each source."""
        return combine_worst(self.focals.values())


def combine_worst(errors: Iterable[Errors]) -> Errors:
    """The largest of each source; NaN where one is."""
    found = np.array([astuple(of) for of in errors])
    return Errors(*found.max(0).tolist())


def measure_errors(fit: BundleFit, registration: Registration) -> AllErrors:
    """Measures the errors of the cameras of `registration`; `fit` has a part of its points."""
    regions, profile, lenses = estimate_spread(fit), profile_focal(fit), doubt_common_lenses(fit)
    freed = free_principal_points(fit)
    turned, shifted = (profile.rotation_deg, profile.centre)
    if freed is not None:
        turned, shifted = np.maximum(turned, freed.rotation_deg), np.maximum(shifted, freed.centre)
    unit = compute_travel(registration)
    cameras = {
        camera.index: PoseErrors(
            rotation=Errors(
                camera.rotation_sigma_deg, regions.rotation_deg[i], float(turned[i]), float(lenses.rotation_deg[i])
            ),
            centre=Errors(
                unit * camera.centre_sigma_rel, regions.centre[i], float(shifted[i]), float(lenses.centre[i])
            ),
        )
        for i, camera in enumerate(registration.cameras)
    }
    lens_of = fit.problem.lens_of_camera
    focals = {
        camera.index: Errors(
            camera.focal_sigma,
            regions.focal_rel[lens_of[i]],
            profile.focal_rel[lens_of[i]],
            float(lenses.focals_rel[i]),
        )
        for i, camera in enumerate(registration.cameras)
    }
    return AllErrors(cameras, focals)


def compute_travel(registration: Registration) -> float:
    """RMS distance of the centres from their mean; the distance to the scene is 1."""
    centres = np.stack([camera.T_world_camera[:3, 3] for camera in registration.cameras])
    return compute_rms_radius(centres)


def extrapolate_pose_errors(registration: Registration, known: Mapping[int, PoseErrors]) -> dict[int, PoseErrors]:
    """Extrapolates the errors of a continuation's cameras, by keyframe, from the `known` ones of some.

    A continuation aligns no patches, so that its sigmas are too large: they shrink as much as those of the known
    cameras do. What is known of a camera besides stays. A further camera is taken for the worst of the known ones, and
    as much worse as its sigma is larger.
    """
    unit = compute_travel(registration)
    rotations = {camera.index: camera.rotation_sigma_deg for camera in registration.cameras}
    centres = {camera.index: unit * camera.centre_sigma_rel for camera in registration.cameras}
    of_rotations = _extrapolate_errors(rotations, {index: of.rotation for index, of in known.items()})
    of_centres = _extrapolate_errors(centres, {index: of.centre for index, of in known.items()})
    return {index: PoseErrors(of_rotations[index], of_centres[index]) for index in rotations}


def extrapolate_focal_errors(registration: Registration, known: Mapping[int, Errors]) -> dict[int, Errors]:
    """Extrapolates the focal errors of a continuation from the `known` ones; the larger sigma counts.

    A further camera has what is known of the least certain focal length.
    """
    least_certain = combine_worst(known.values())
    found = {}
    for camera in registration.cameras:
        was = known.get(camera.index, least_certain)
        found[camera.index] = replace(was, sigma=float(np.maximum(was.sigma, camera.focal_sigma)))
    return found


def _extrapolate_errors(sigmas: Mapping[int, float], known: Mapping[int, Errors]) -> dict[int, Errors]:
    ratios = [of.sigma / max(sigmas[index], MIN_SIGMA) for index, of in known.items()]
    sharper = float(np.clip(np.median(ratios), LEAST_SHARPER, 1.0))
    largest = Errors(*np.array([astuple(of) for of in known.values()]).max(0).tolist())
    found = {}
    for index, sigma in sigmas.items():
        worse = max(1.0, sharper * sigma / max(largest.sigma, MIN_SIGMA))
        further = (worse * largest.regions, worse * largest.profile, worse * largest.lenses)
        was = known.get(index) or Errors(sharper * sigma, *further)
        found[index] = replace(was, sigma=sharper * sigma)
    return found
