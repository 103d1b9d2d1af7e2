"""The last adjustment of a map: more tracks, subpixel observations, lenses as free as their priors leave them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import distortion
from splatnode.recon.registration import bundle, incremental, subpixel, triangulation
from splatnode.recon.registration.lenses import CORNER, LEAST_SHIFT
from splatnode.recon.registration.mapping_problem import MapperInput, PartialMap
from splatnode.recon.registration.patch_image import PatchImage

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_ROBUST_PER_MEDIAN = 3.0  # scale of the robust loss over the median error
_TOLERANCES = (3.0, 2.0, 1.0)  # of observations, in one adjustment after the other: multiples of `max_error_px`
_REFINED_ADJUSTMENTS = 3  # with subpixel observations; each drops outliers, and the next one fits better
_WIDEST_RADIAL = 0.3  # prior standard deviation of a radial coefficient before observations tell how large it is
_MIN_OBSERVATIONS = 6  # of a registered camera: three fix a pose, twice as many check it


class FinalAdjustmentConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    triangulation: triangulation.TriangulationConfig = triangulation.TriangulationConfig()
    subpixel: subpixel.SubpixelConfig = subpixel.SubpixelConfig()
    min_points: int = 15  # points that a map needs
    # Smallest and largest scale of the robust loss, pixels at REFERENCE_SIDE
    robust_range_px: tuple[float, float] = (0.15, 1.5)
    # So many observations tell as much as one with an error of its own, because what lens, shutter and scene do
    # otherwise than the model moves whole regions alike. With this number, errors of real cameras are as large as
    # their sigmas say (tests/bench/quality/poses.py).
    correlated: float = 100.0
    # Prior standard deviation of the radial coefficient of a lens that is not calibrated, where pictures tell little
    radial_sigma: float = 0.02
    shift_sigma: float = 0.004  # that of its principal point, as a share of the longer side


@dataclass(frozen=True, eq=False)
class FinalMap:
    """A map after its last adjustment."""

    map: PartialMap
    loss: bundle.BundleAdjustmentConfig  # of that adjustment
    rms_px: float  # of the observations' errors, pixels at REFERENCE_SIDE


def run_final_adjustment(
    problem: MapperInput, partial: PartialMap, images: Sequence[PatchImage], config: FinalAdjustmentConfig
) -> FinalMap | None:
    """The map of the final tracks, adjusted until it has settled, or None when too few points are left.

    `images`, one a view, give subpixel observations; where there are none, the features' positions are kept.
    """
    partial = replace(partial, prior=_free_lenses(problem, partial.prior, config))
    for tolerance in _TOLERANCES:
        partial = _adjust_final_tracks(problem, partial, tolerance, config)
        if len(partial.estimate.points) < config.min_points:
            return None
    bending = _find_distorting_lenses(problem, partial.estimate)
    if bending.any():
        partial = _adjust_final_tracks(problem, _free_second_radial(partial, bending), _TOLERANCES[-1], config)
        if len(partial.estimate.points) < config.min_points:
            return None
    if images:
        refined = subpixel.refine(partial.estimate, partial.registered, images, config.subpixel)
        if len(refined.points) >= config.min_points and _has_enough_observations(refined, partial.registered):
            partial = replace(partial, estimate=refined)
            for _ in range(_REFINED_ADJUSTMENTS):
                partial = _fit_radial_prior(_adjust_and_filter(problem, partial, config), config)
    loss, errors = _loss(problem, partial.estimate, config), _errors(problem, partial.estimate)
    return FinalMap(partial, loss, float(np.sqrt(np.mean(errors**2))))


def _adjust_final_tracks(
    problem: MapperInput, partial: PartialMap, tolerance: float, config: FinalAdjustmentConfig
) -> PartialMap:
    """The map after an adjustment to the final tracks, its lenses held by what it found of them."""
    loss = _loss(problem, partial.estimate, config)
    adjusted = incremental.adjust(problem, partial, problem.final_tracks, loss, tolerance, config.triangulation)
    return _fit_radial_prior(adjusted, config)


def _free_lenses(problem: MapperInput, prior: bundle.LensPrior, config: FinalAdjustmentConfig) -> bundle.LensPrior:
    """The prior with distortion and principal point free for all lenses that are not calibrated."""
    unknown = prior.sigmas > 0
    radial_sigmas = np.column_stack([_WIDEST_RADIAL * unknown, np.zeros(len(unknown))])
    least = config.shift_sigma * _longer_sides(problem) * unknown
    return replace(prior, radial_sigmas=radial_sigmas, shift_sigmas=np.maximum(prior.shift_sigmas, least))


def _longer_sides(problem: MapperInput) -> Array:
    """(G,) of each lens' largest picture, pixels."""
    lenses = range(len(problem.lenses))
    sides = (max((view.longer_side for view in problem.views if view.lens == g), default=1) for g in lenses)
    return np.array(list(sides), np.float64)


def _fit_radial_prior(partial: PartialMap, config: FinalAdjustmentConfig) -> PartialMap:
    """The map with a prior under which a radial coefficient is as likely as it was found, or as `config` has it.

    A prior as wide as what is found lets a coefficient stay where observations tell it to within half of what it is;
    any other falls, adjustment by adjustment, to where `config` holds it (MacKay, "Bayesian interpolation", 1992).
    """
    found = np.maximum(np.abs(partial.estimate.radials), config.radial_sigma)
    sigmas = np.where(partial.prior.radial_sigmas > 0, found, 0.0)
    return replace(partial, prior=replace(partial.prior, radial_sigmas=sigmas))


def _find_distorting_lenses(problem: MapperInput, estimate: bundle.Problem) -> Flags:
    """(G,) the lenses whose distortion moves the corners of their pictures by more than LEAST_SHIFT."""
    focals = np.exp(estimate.log_focals) / _longer_sides(problem)
    corners = CORNER / focals
    return np.abs(distortion(corners**2, estimate.radials) - 1.0) * corners * focals > LEAST_SHIFT


def _free_second_radial(partial: PartialMap, lenses: Flags) -> PartialMap:
    """The map with the second coefficient free of those of the `lenses` (G,) whose first one is."""
    sigmas = partial.prior.radial_sigmas.copy()
    sigmas[lenses & (sigmas[:, 0] > 0), 1] = _WIDEST_RADIAL
    return replace(partial, prior=replace(partial.prior, radial_sigmas=sigmas))


def _loss(
    problem: MapperInput, estimate: bundle.Problem, config: FinalAdjustmentConfig
) -> bundle.BundleAdjustmentConfig:
    """The scale of the robust loss and the noise of an observation, from the residuals."""
    scale = float(np.median(problem.scale))
    if len(estimate.points) == 0:
        return bundle.BundleAdjustmentConfig(robust_px=scale * config.robust_range_px[1])
    median = float(np.median(_errors(problem, estimate)))
    noise_px = bundle.noise_px(len(estimate.pixels), len(estimate.points), median)
    return bundle.BundleAdjustmentConfig(
        robust_px=scale * float(np.clip(_ROBUST_PER_MEDIAN * median, *config.robust_range_px)),
        noise_px=scale * noise_px * float(np.sqrt(config.correlated)),
    )


def _adjust_and_filter(problem: MapperInput, partial: PartialMap, config: FinalAdjustmentConfig) -> PartialMap:
    """The map after a bundle adjustment, without observations with large errors and points with fewer than two."""
    loss = _loss(problem, partial.estimate, config)
    estimate = bundle.adjust(partial.estimate, partial.prior, loss, partial.registered[0])
    good = _errors(problem, estimate) < config.triangulation.max_error_px
    good &= np.bincount(estimate.point_of[good], minlength=len(estimate.points))[estimate.point_of] >= 2
    kept, point_of = np.unique(estimate.point_of[good], return_inverse=True)
    filtered = replace(
        estimate,
        points=estimate.points[kept],
        camera_of=estimate.camera_of[good],
        point_of=point_of,
        pixels=estimate.pixels[good],
    )
    return replace(partial, estimate=filtered if _has_enough_observations(filtered, partial.registered) else estimate)


def _has_enough_observations(estimate: bundle.Problem, registered: Sequence[int]) -> bool:
    """Whether every registered camera has enough observations for its pose, or a given pose that holds it."""
    enough = np.bincount(estimate.camera_of, minlength=len(estimate.rotations)) >= _MIN_OBSERVATIONS
    if estimate.given is not None:
        enough |= estimate.given.is_held
    return bool(enough[list(registered)].all())


def _errors(problem: MapperInput, estimate: bundle.Problem) -> Array:
    """(O,) reprojection errors, pixels at REFERENCE_SIDE."""
    return bundle.reprojection_errors(estimate) / problem.scale[estimate.camera_of]
