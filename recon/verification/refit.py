"""A registration adjusted once more: from another start, from some of its points, or with a lens set free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import REFERENCE_SIDE, Keyframe, longer_side
from splatnode.recon.geometry import align_cameras, angles_deg, compute_rms_radius, umeyama
from splatnode.recon.registration import bundle, finishing, lenses, own_lenses, tracks
from splatnode.recon.registration.register import Registration

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

NOMINAL_SIGMA = lenses.LensGroupingConfig().exif_sigma
FREE_SIGMA = 0.3  # of log focal where nothing is known: one sigma is a factor of 1.35
FREE_SHIFT = lenses.LensGroupingConfig().free_shift_sigma  # of the longer side, of a principal point that was displaced
FREE_ASPECT = 0.1  # of log aspect, where pixels are not square
SQUARE = 1e-3  # difference of an aspect from 1 from which on they are not
ROBUST_FACTOR = 3.0  # width of the Cauchy loss over the median error
ROBUST_PX = (0.4, 1.5)  # least and most width of the Cauchy loss, pixels at REFERENCE_SIDE
MIN_COST = 1e-12  # pixels squared: a smaller cost counts as this one where ratios are taken; made-up data have none
MIN_FOR_CENTRES = 3  # cameras whose centres alone fix a similarity; those of two leave a turn about their line open
MIN_SPREAD = 1e-12  # of centres, as MIN_COST: all in one place


@dataclass(frozen=True, eq=False)
class BundleFit:
    """A bundle that holds C registered cameras, numbered in their order, with what is known of their lenses."""

    problem: bundle.Problem
    prior: bundle.LensPrior
    loss: bundle.BundleAdjustmentConfig
    scale: float  # longer side of the largest frame, whose pixels these are, over REFERENCE_SIDE
    told: Array  # (G,) focal length that came with the frames; NaN where none did
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
        return replace(self, problem=bundle.adjust(self.problem, self.prior, self.loss))

    @property
    def cost(self) -> float:
        """Robust cost of an observation, pixels squared; NaN where a camera or a lens is no longer a number.

        The bundle counts an observation without a depth as one behind its camera, and would hide that.
        """
        lenses = (self.problem.log_focals, self.problem.radials, self.problem.shifts)
        if not all(np.isfinite(known).all() for known in (self.Ts_world_camera, *lenses)):
            return np.nan
        return bundle.robust_cost(self.problem, self.loss) / max(1, len(self.problem.pixels))


def build_fit(keyframes: Sequence[Keyframe], registration: Registration, tracks_per_camera: int) -> BundleFit:
    """The registration as a bundle of at most about `tracks_per_camera` tracks a camera, the longest first.

    A given focal length is kept, others are almost free. Pixels are those of frames enlarged to the largest of all.
    """
    cameras = registration.cameras
    position = np.full(len(keyframes), -1)
    position[[camera.index for camera in cameras]] = np.arange(len(cameras))
    camera_of = position[registration.observed_by]
    chosen = tracks.longest(camera_of, registration.observed_point, len(registration.points), tracks_per_camera)
    observed = chosen[registration.observed_point]
    sides = np.array([longer_side(keyframes[c.index].frame) for c in cameras])
    numbers, lens_of_camera = np.unique([camera.lens for camera in cameras], return_inverse=True)
    count, largest = len(numbers), sides.max()
    units = np.array([sides[lens_of_camera == lens].max() for lens in range(count)]) / largest
    enlarged = largest / sides
    focals, aspects, radials, sigmas = np.zeros(count), np.zeros(count), np.zeros((count, 2)), np.zeros(count)
    told, nominal = np.full(count, np.nan), np.full(count, np.inf)
    shift_sigmas, aspect_sigmas, own = np.zeros(count), np.zeros(count), np.zeros(count, bool)
    near = np.full(count, -1)
    for camera, lens, by in zip(cameras, lens_of_camera, enlarged, strict=True):
        given = None if camera.own_lens else keyframes[camera.index].frame.intrinsics
        focals[lens], aspects[lens], radials[lens] = by * camera.focal, camera.aspect, camera.radial
        told[lens] = np.nan if given is None else by * given.fx
        calibrated = given is not None and given.source in ("given", "calibration")
        sigmas[lens] = 0.0 if calibrated else FREE_SIGMA
        nominal[lens] = np.inf if given is None or calibrated else NOMINAL_SIGMA
        shift_sigmas[lens] = FREE_SHIFT * largest if camera.displaced else 0.0
        aspect_sigmas[lens] = FREE_ASPECT if abs(camera.aspect - 1.0) > SQUARE else 0.0
        own[lens], near[lens] = camera.own_lens, camera.near_lens
    principal = np.stack([camera.principal for camera in cameras])
    Ts_camera_world: Array = np.linalg.inv(np.stack([camera.T_world_camera for camera in cameras])).astype(np.float64)
    (kept,) = np.nonzero(chosen)
    problem = bundle.Problem(
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
    )
    scale = float(largest) / REFERENCE_SIDE
    is_nominal = np.isfinite(nominal)
    means = np.where(is_nominal, np.log(np.where(is_nominal, told, 1.0)), problem.log_focals)
    prior = bundle.LensPrior(
        log_focals=means,
        sigmas=np.minimum(sigmas, nominal),
        radial_sigmas=np.zeros((count, 2)),
        shift_sigmas=shift_sigmas,
        aspect_sigmas=aspect_sigmas,
        ties=_tie_near_lenses(numbers, near),
    )
    errors = bundle.reprojection_errors(problem)
    median = float(np.median(errors))
    robust_px = float(np.clip(ROBUST_FACTOR * median, *(np.array(ROBUST_PX) * scale)))
    noise = bundle.noise_px(len(problem.pixels), len(problem.points), median / scale)
    loss = bundle.BundleAdjustmentConfig(
        robust_px=robust_px, noise_px=scale * noise * float(np.sqrt(finishing.FinalAdjustmentConfig().correlated))
    )
    return BundleFit(problem, prior, loss, scale, told, nominal, own, units)


def _tie_near_lenses(numbers: Index, near: Index) -> bundle.LensTies | None:
    """Ties the focal lengths of lenses that are near one lens to that one, or to the first of them."""
    to, sigmas = np.full(len(numbers), -1), np.zeros((len(numbers), 6))
    for common in np.unique(near[near >= 0]):
        (members,) = np.nonzero(near == common)
        (itself,) = np.nonzero(numbers == common)
        first = itself[0] if len(itself) else members[0]
        others = members[members != first]
        to[others], sigmas[others, 0] = first, own_lenses.OwnLensesConfig().focal_sigma
    return bundle.LensTies(to, sigmas) if (to >= 0).any() else None


def compute_nominal_cost(of: BundleFit) -> float:
    """Returns how far nominal focal lengths are from those of the fit: squares of standard errors.

    All EXIF data of a camera err together: each lens counts as a share of one observation.
    """
    known = np.isfinite(of.nominal_sigmas)
    if not known.any():
        return 0.0
    off = (of.problem.log_focals - np.log(np.where(known, of.told, 1.0))) / of.nominal_sigmas
    return float(np.mean(off[known] ** 2))


def adjust(start: BundleFit) -> BundleFit:
    return start.minimum


def estimate_noise_px(of: BundleFit) -> float:
    """The standard deviation of one component of an observation's error, pixels of the largest frame; never 0."""
    median = float(np.median(bundle.reprojection_errors(of.problem))) / of.scale
    return of.scale * bundle.noise_px(len(of.problem.pixels), len(of.problem.points), median)


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


def Ts_world_camera(problem: bundle.Problem) -> Array:
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
    onto = umeyama(centres, target) if count >= MIN_FOR_CENTRES else common
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
