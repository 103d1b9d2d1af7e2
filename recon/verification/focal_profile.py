"""What the focal length leaves open: the profile of the cost over it, and how far the cameras move along it.

Where all cameras look the same way, or turn about what they see, depth and focal length trade against each other (the
bas-relief ambiguity: Belhumeur et al. 1999), and the cost is no parabola: the covariance at its minimum says too
little. Here the focal length is held at steps beside its best value, and all else is adjusted anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import finishing
from splatnode.recon.verification import refit

Array = npt.NDArray[np.float64]

STEPS = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)  # of log focal, either way; the last is a factor of 1.9
# Rise of the cost, in units of the variance of an observation, that counts as one standard error. Observations err
# together: so many of them tell as much as one with an error of its own, as in registration's covariance. What EXIF
# says of the focal length is one observation more.
ONE_SIGMA = finishing.FinalAdjustmentConfig().correlated


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
    moved: refit.CameraShifts


def profile_focal(fit: refit.BundleFit) -> FocalProfile:
    """Profiles the lenses that are not calibrated, all changed by one factor; all 0 where every lens is.

    NaN where the fit has come to nothing.
    """
    whole = refit.adjust(fit)
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


def _find_interval_end(whole: refit.BundleFit, direction: Array) -> _ProfileStep:
    """One end of the interval: between the last step within it and the first beyond, both moved alike."""
    count = len(whole.problem.rotations)
    before = _ProfileStep(0.0, 0.0, refit.CameraShifts(np.zeros(count), np.zeros(count), np.zeros(len(direction))))
    for step in _compute_steps(whole, direction):
        if step.sigmas >= 1.0:
            share = (1.0 - before.sigmas) / max(step.sigmas - before.sigmas, refit.MIN_COST)
            return _interpolate_step(before, step, share)
        before = _ProfileStep(step.focal_rel, step.sigmas, _combine_farthest(before.moved, step.moved))
    return before


def _compute_steps(whole: refit.BundleFit, direction: Array) -> Iterator[_ProfileStep]:
    noise2 = refit.estimate_noise_px(whole) ** 2
    held = replace(whole, prior=replace(whole.prior, sigmas=np.zeros_like(whole.prior.sigmas)))
    for size in STEPS:
        log_focals = whole.problem.log_focals + size * direction
        held = refit.adjust(replace(held, problem=replace(held.problem, log_focals=log_focals)))
        rise = (held.cost - whole.cost) * len(whole.problem.pixels) / noise2 / ONE_SIGMA
        rise += refit.compute_nominal_cost(held) - refit.compute_nominal_cost(whole)
        yield _ProfileStep(size, float(np.sqrt(np.maximum(rise, 0.0))), refit.compute_camera_shifts(whole, held))


def _interpolate_step(before: _ProfileStep, after: _ProfileStep, share: float) -> _ProfileStep:
    """A step that lies `share` of the way from one to the other."""

    def interpolate(one: Array, other: Array) -> Array:
        return one + share * (other - one)

    moved = refit.CameraShifts(
        interpolate(before.moved.rotation_deg, after.moved.rotation_deg),
        interpolate(before.moved.centre, after.moved.centre),
        interpolate(before.moved.focals_rel, after.moved.focals_rel),
    )
    return _ProfileStep(before.focal_rel + share * (after.focal_rel - before.focal_rel), 1.0, moved)


def _combine_farthest(one: refit.CameraShifts, other: refit.CameraShifts) -> refit.CameraShifts:
    return refit.CameraShifts(
        np.maximum(one.rotation_deg, other.rotation_deg),
        np.maximum(one.centre, other.centre),
        np.maximum(one.focals_rel, other.focals_rel),
    )
