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
ONE_SIGMA = finishing.Config().correlated


@dataclass(frozen=True)
class Profile:
    """The interval of one standard error, and the most that the cameras move within it."""

    # Of each lens: the wider side of the interval, of log focal; the last step where the cost never rises so far
    focal_rel: tuple[float, ...]
    rotation_deg: tuple[float, ...]  # of each camera, after the best common rotation
    centre: tuple[float, ...]  # of each camera, after the best similarity, in the unit of the world


@dataclass(frozen=True, eq=False)
class _Step:
    """All is relative to the best fit."""

    focal_rel: float
    sigmas: float  # the root of the rise of the cost, in standard errors
    moved: refit.Moved


def profile(fit: refit.Fit) -> Profile:
    """Of the lenses that did not come calibrated, all changed by one factor. All is 0 where every lens did.

    NaN where the fit has come to nothing.
    """
    whole = refit.adjusted(fit)
    count = len(whole.problem.rotations)
    if not np.isfinite(whole.cost):
        return Profile((np.nan,) * len(whole.prior.sigmas), (np.nan,) * count, (np.nan,) * count)
    free = (whole.prior.sigmas > 0).astype(np.float64)
    ends = [_end(whole, direction) for direction in (free, -free)] if free.any() else []
    still = np.zeros(count)
    return Profile(
        focal_rel=tuple((max((end.focal_rel for end in ends), default=0.0) * free).tolist()),
        rotation_deg=tuple(np.max([still, *(end.moved.rotation_deg for end in ends)], axis=0).tolist()),
        centre=tuple(np.max([still, *(end.moved.centre for end in ends)], axis=0).tolist()),
    )


def _end(whole: refit.Fit, direction: Array) -> _Step:
    """One end of the interval: between the last step within it and the first beyond, both moved alike."""
    count = len(whole.problem.rotations)
    before = _Step(0.0, 0.0, refit.Moved(np.zeros(count), np.zeros(count), np.zeros(len(direction))))
    for step in _steps(whole, direction):
        if step.sigmas >= 1.0:
            share = (1.0 - before.sigmas) / max(step.sigmas - before.sigmas, refit.MIN_COST)
            return _between(before, step, share)
        before = _Step(step.focal_rel, step.sigmas, _farther(before.moved, step.moved))
    return before


def _steps(whole: refit.Fit, direction: Array) -> Iterator[_Step]:
    noise2 = refit.noise_px(whole) ** 2
    held = replace(whole, prior=replace(whole.prior, sigmas=np.zeros_like(whole.prior.sigmas)))
    for size in STEPS:
        log_focals = whole.problem.log_focals + size * direction
        held = refit.adjusted(replace(held, problem=replace(held.problem, log_focals=log_focals)))
        rise = (held.cost - whole.cost) * len(whole.problem.pixels) / noise2 / ONE_SIGMA
        rise += refit.nominal_cost(held) - refit.nominal_cost(whole)
        yield _Step(size, float(np.sqrt(np.maximum(rise, 0.0))), refit.moved(whole, held))


def _between(before: _Step, after: _Step, share: float) -> _Step:
    """A step that lies `share` of the way from one to the other."""

    def mixed(one: Array, other: Array) -> Array:
        return one + share * (other - one)

    moved = refit.Moved(
        mixed(before.moved.rotation_deg, after.moved.rotation_deg),
        mixed(before.moved.centre, after.moved.centre),
        mixed(before.moved.focals_rel, after.moved.focals_rel),
    )
    return _Step(before.focal_rel + share * (after.focal_rel - before.focal_rel), 1.0, moved)


def _farther(one: refit.Moved, other: refit.Moved) -> refit.Moved:
    return refit.Moved(
        np.maximum(one.rotation_deg, other.rotation_deg),
        np.maximum(one.centre, other.centre),
        np.maximum(one.focals_rel, other.focals_rel),
    )
