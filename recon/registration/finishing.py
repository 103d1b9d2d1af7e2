"""The last adjustment of a map: all tracks, exact observations, lenses as free as their priors leave them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle, incremental, subpixel, triangulation
from splatnode.recon.registration.mapping_problem import Growth, Survey
from splatnode.recon.registration.subpixel import Picture

Array = npt.NDArray[np.float64]

_MEDIAN_LENGTH = 1.1774  # of two independent numbers of variance 1
_LEAST_NOISE_PX = 0.05  # at 1024 px: what no observation is believed to be better than


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    triangulation: triangulation.Config = triangulation.Config()
    subpixel: subpixel.Config = subpixel.Config()
    min_points: int = 15
    robust_range_px: tuple[float, float] = (0.15, 1.5)  # three times the median error, within these limits
    # Errors are not independent: what the lens, the shutter and the scene do otherwise than the model moves whole
    # regions alike. So many observations know as much as one with an error of its own; with this number, errors of
    # real cameras are as large as their sigmas say (tests/bench/quality/poses.py).
    correlated: float = 100.0
    radial_sigma: float = 0.02  # of the radial coefficient of a lens that is not calibrated
    shift_sigma: float = 0.004  # of its principal point, of the longer side


@dataclass(frozen=True, eq=False)
class Finished:
    incremental: Growth
    loss: bundle.Config
    rms_px: float  # of the observations, at 1024 px on the longer side


def finish(of: Survey, grown: Growth, pictures: Sequence[Picture], config: Config) -> Finished | None:
    """The map of all tracks, adjusted to the end, or None when too few points are left.

    `pictures`, one a view, make the observations exact; without any, the features' positions stand.
    """
    grown = replace(grown, prior=_free_lenses(of, grown.prior, config))
    loss = _loss(of, grown, config)
    for widen in (3.0, 2.0, 1.0):
        grown = incremental.adjusted(of, grown, of.fine, loss, widen, config.triangulation)
        if len(grown.problem.points) < config.min_points:
            return None
        loss = _loss(of, grown, config)
    if pictures:
        refined = subpixel.refine(grown.problem, grown.registered, pictures, config.subpixel)
        if len(refined.points) >= config.min_points and _all_observed(refined, grown.registered):
            grown = replace(grown, problem=refined)
            for _ in range(3):
                grown = _readjusted(of, grown, _loss(of, grown, config), config)
            loss = _loss(of, grown, config)
    errors = _errors(of, grown.problem)
    return Finished(grown, loss, float(np.sqrt(np.mean(errors**2))))


def _free_lenses(of: Survey, prior: bundle.LensPrior, config: Config) -> bundle.LensPrior:
    """The prior that frees distortion and principal point of all lenses that are not calibrated."""
    unknown = prior.sigmas > 0
    longer_side = np.array([max(v.longer_side for v in of.views if v.lens == g) for g in range(len(of.lenses))])
    return replace(
        prior, radial_sigmas=config.radial_sigma * unknown, shift_sigmas=config.shift_sigma * longer_side * unknown
    )


def _loss(of: Survey, grown: Growth, config: Config) -> bundle.Config:
    """Robust scale and noise from the residuals."""
    problem, scale = grown.problem, float(np.median(of.scale))
    if len(problem.points) == 0:
        return bundle.Config(robust_px=scale * config.robust_range_px[1])
    median = float(np.median(_errors(of, problem)))
    # A point seen twice fits three of four numbers: residuals are smaller than errors.
    observed = 2 * len(problem.pixels)
    shrunk = np.sqrt(observed / max(1, observed - 3 * len(problem.points)))
    noise_px = max(shrunk * median / _MEDIAN_LENGTH, _LEAST_NOISE_PX)
    return bundle.Config(
        robust_px=scale * float(np.clip(3.0 * median, *config.robust_range_px)),
        noise_px=scale * noise_px * float(np.sqrt(config.correlated)),
    )


def _readjusted(of: Survey, grown: Growth, loss: bundle.Config, config: Config) -> Growth:
    """Everything adjusted, then observations with large errors left out, and points with fewer than two."""
    problem = bundle.adjust(grown.problem, grown.prior, loss, grown.registered[0])
    good = _errors(of, problem) < config.triangulation.max_error_px
    good &= np.bincount(problem.point_of[good], minlength=len(problem.points))[problem.point_of] >= 2
    kept, point_of = np.unique(problem.point_of[good], return_inverse=True)
    thinned = replace(
        problem,
        points=problem.points[kept],
        camera_of=problem.camera_of[good],
        point_of=point_of,
        pixels=problem.pixels[good],
    )
    return replace(grown, problem=thinned if _all_observed(thinned, grown.registered) else problem)


def _all_observed(problem: bundle.Problem, registered: Sequence[int]) -> bool:
    """Whether every registered camera has what fixes a pose with some to spare."""
    counts = np.bincount(problem.camera_of, minlength=len(problem.rotations))
    return bool((counts[list(registered)] >= 6).all())


def _errors(of: Survey, problem: bundle.Problem) -> Array:
    """(O,) pixels at 1024 px on the longer side."""
    return bundle.reprojection_errors(problem) / of.scale[problem.camera_of]
