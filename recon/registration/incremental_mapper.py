"""Incremental mapping of few views: attempts with several first pairs and focal lengths, of which the best is kept.

With a handful of views there is time to try. Attempts are scored by ALL pairwise matches, those included that a model
was not built from.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import distortion
from splatnode.recon.matching.pair_matching import count_explained, fit_epipolar_errors
from splatnode.recon.registration import (
    bundle_adjustment,
    mapping_problem,
    multiview_geometry,
    self_calibration,
    subpixel,
)
from splatnode.recon.registration.mapping_problem import (
    Lens,
    MapperInput,
    MapperView,
    OwnLens,
    Pair,
    Pairs,
    Resection,
    SparseModel,
)
from splatnode.recon.registration.multiview_geometry import Tracks
from splatnode.recon.registration.self_calibration import CORNER, LEAST_SHIFT
from splatnode.recon.registration.subpixel import PatchImage
from splatnode.recon.threads import BACKGROUND, RunContext, map_parallel

# Incremental mapping: a first pair, then one view after the other, with a bundle adjustment after each.

Array = npt.NDArray[np.float64]

# The less is settled, the larger errors may be, as multiples of `triangulation.max_error_px`, for a point to be kept:
_FIRST_PAIR_TOLERANCE = 4.0  # with two views and a guessed focal length
_NEW_VIEW_TOLERANCE = 3.0  # with a view that has just been resected
SETTLED_TOLERANCE = 2.0  # with views that have been adjusted before

# A bundle adjustment after each view need not converge: the next view changes the model again.
_QUICK_ITERATIONS, _QUICK_DECREASE = 10, 1e-3

_MIN_IMPROVEMENT = 1.05  # factor of the score by which another model must be better to replace one
_MIN_VIEWS = 3  # that must stay when doubtful ones are removed
_FEW_VIEWS = 3  # for which a lens each is tried: from a model with a common one, lenses of more views are found


class IncrementalMapperConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Incremental mapping: a first pair, then one view after the other, with a bundle adjustment after each."""

    resection: mapping_problem.ResectionConfig = mapping_problem.ResectionConfig()
    triangulation: multiview_geometry.TriangulationConfig = multiview_geometry.TriangulationConfig()
    robust_px: float = 1.0  # scale of the robust loss, pixels at REFERENCE_SIDE
    min_points: int = 15  # points that a model needs
    candidates: int = 3  # views that are resected before the best of them is registered
    min_view_ratio: float = 0.6  # inlier ratio of a view's matches below which it is removed and resected again
    # Standard deviation of log focal while there are two views, which say little about it
    pair_focal_sigma: float = 0.03


def grow(problem: MapperInput, focals: list[float], first: Pair, config: IncrementalMapperConfig) -> SparseModel | None:
    """A model from the pair `first` on, with every view that can be registered; None where the pair gives too little.

    `focals` (one a lens) are in pixels.
    """
    partial = _initialise(problem, focals, first, config)
    return _repair(problem, extend(problem, partial, config), config) if partial else None


def score(problem: MapperInput, partial: SparseModel, zero_px: float) -> float:
    """The number of matches that the model explains, of all pairs; one with error e counts 1 - (e / zero_px)^2.

    `zero_px` is in pixels at REFERENCE_SIDE; matches with larger errors count 0.
    """
    errors = mapping_problem.pair_errors(problem, partial).values()
    return sum(count_explained(of_pair, zero_px) for of_pair in errors)


def adjust(
    problem: MapperInput,
    partial: SparseModel,
    tracks: Tracks,
    loss: bundle_adjustment.BundleAdjustmentConfig,
    tolerance: float,
    config: multiview_geometry.TriangulationConfig,
) -> SparseModel:
    """The model with all points triangulated anew (see `retriangulate` for `tolerance`), then bundle-adjusted."""
    estimate, track_of_point = multiview_geometry.retriangulate(
        partial.estimate, tracks, partial.registered, problem.scale, config, tolerance
    )
    if len(estimate.points):
        estimate = bundle_adjustment.adjust(estimate, partial.prior, loss, partial.registered[0])
    return replace(partial, estimate=estimate, track_of_point=track_of_point)


def adjust_quickly(
    problem: MapperInput, partial: SparseModel, tolerance: float, config: IncrementalMapperConfig
) -> SparseModel:
    """`adjust` with few tracks and few iterations, for after each view."""
    robust_px = config.robust_px * float(np.median(problem.scale))
    loss = bundle_adjustment.BundleAdjustmentConfig(
        robust_px=robust_px, max_iterations=_QUICK_ITERATIONS, tolerance=_QUICK_DECREASE
    )
    return adjust(problem, partial, problem.growing_tracks, loss, tolerance, config.triangulation)


def _initialise(
    problem: MapperInput, focals: list[float], first: Pair, config: IncrementalMapperConfig
) -> SparseModel | None:
    """The model of the pair `first`: its first view is the world's origin, its baseline the unit of length."""
    count = len(problem.views)
    rotation, direction, num_inliers = multiview_geometry.relative_pose(
        problem.pairs[first],
        focals[problem.views[first[0]].lens],
        focals[problem.views[first[1]].lens],
        config.triangulation.max_error_px * float(problem.scale[first[0]]),
    )
    if num_inliers < config.min_points:
        return None
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    rotations[first[1]], translations[first[1]] = rotation, direction
    estimate = bundle_adjustment.make_empty_problem(
        rotations=rotations,
        translations=translations,
        lens_of_camera=np.array([view.lens for view in problem.views]),
        log_focals=np.log(focals),
        radials=np.array([lens.radial for lens in problem.lenses]),
        shifts=np.zeros((len(problem.lenses), 2)),
    )
    prior = bundle_adjustment.focal_prior(np.log(focals), np.array([lens.sigma for lens in problem.lenses]))
    tight = replace(prior, sigmas=np.minimum(prior.sigmas, config.pair_focal_sigma))
    start = SparseModel(first, estimate, tight, np.zeros(0, np.int64))
    partial = adjust_quickly(problem, start, _FIRST_PAIR_TOLERANCE, config)
    return replace(partial, prior=prior) if len(partial.estimate.points) >= config.min_points else None


def extend(problem: MapperInput, partial: SparseModel, config: IncrementalMapperConfig) -> SparseModel:
    """The model with every further view that can be registered.

    Of the views that observe most of the model, the one with the highest inlier ratio comes next: a view that repeated
    structures misplace contradicts some of its neighbours, and waits until more of them are registered.
    """
    failed: set[int] = set()
    while len(partial.registered) + len(failed) < len(problem.views):
        candidates = _next_views(problem, partial, failed)[: config.candidates]
        resect = functools.partial(mapping_problem.resect, problem, partial, config=config.resection)
        tried = dict(zip(candidates, map_parallel(resect, candidates), strict=True))
        found: dict[int, Resection] = {view: resected for view, resected in tried.items() if resected is not None}
        failed |= tried.keys() - found.keys()
        if not found:
            continue
        best = max(found, key=lambda view: (found[view].inlier_ratio, -view))
        estimate = bundle_adjustment.replace_pose(partial.estimate, best, found[best].rotation, found[best].translation)
        larger = replace(partial, estimate=estimate, registered=(*partial.registered, best))
        partial = adjust_quickly(problem, larger, _NEW_VIEW_TOLERANCE, config)
        failed.clear()  # The new view brings new points, from which others may now be resected.
    return partial


def _next_views(problem: MapperInput, partial: SparseModel, failed: set[int]) -> list[int]:
    """The views that are not registered and have not failed; those that observe most of the model's points first."""
    tracks = problem.growing_tracks
    in_model = np.isin(tracks.track_of, partial.track_of_point)
    counts = np.bincount(tracks.camera_of[in_model], minlength=len(problem.views))
    waiting = [view for view in range(len(problem.views)) if view not in partial.registered and view not in failed]
    return sorted(waiting, key=lambda view: (-counts[view], view))


def _repair(problem: MapperInput, partial: SparseModel, config: IncrementalMapperConfig) -> SparseModel:
    """The model after views with low inlier ratios have been removed and resected, where that raises the score.

    First all of them at once, because misplaced views may support each other; then one after the other.
    """
    doubtful = _find_weak_views(problem, partial, config)
    for group in [doubtful, *([view] for view in doubtful)]:
        rest = tuple(view for view in partial.registered if view not in group)
        if not group or len(rest) < _MIN_VIEWS:
            continue
        without = adjust_quickly(problem, replace(partial, registered=rest), SETTLED_TOLERANCE, config)
        if len(without.estimate.points) < config.min_points:
            continue
        again = extend(problem, without, config)
        limit = config.triangulation.max_error_px
        if score(problem, again, limit) > _MIN_IMPROVEMENT * score(problem, partial, limit):
            partial = again
    return partial


def _find_weak_views(problem: MapperInput, partial: SparseModel, config: IncrementalMapperConfig) -> list[int]:
    """The registered views with an inlier ratio below `min_view_ratio`, the lowest first."""
    ratios = mapping_problem.inlier_ratios(problem, partial, config.triangulation.max_error_px)
    of_view = {view: mapping_problem.compute_pooled_ratio(ratios, problem.pairs, view) for view in partial.registered}
    return sorted((view for view in of_view if of_view[view] < config.min_view_ratio), key=lambda view: of_view[view])


# The last adjustment of a model: more tracks, subpixel observations, lenses as free as their priors leave them.

Flags = npt.NDArray[np.bool_]

_ROBUST_PER_MEDIAN = 3.0  # scale of the robust loss over the median error
_TOLERANCES = (3.0, 2.0, 1.0)  # of observations, in one adjustment after the other: multiples of `max_error_px`
_REFINED_ADJUSTMENTS = 3  # with subpixel observations; each drops outliers, and the next one fits better
_WIDEST_RADIAL = 0.3  # prior standard deviation of a radial coefficient before observations tell how large it is
_MIN_OBSERVATIONS = 6  # of a registered camera: three fix a pose, twice as many check it


class FinalAdjustmentConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The last adjustment of a model: more tracks, subpixel observations, lenses as free as their priors leave them."""

    triangulation: multiview_geometry.TriangulationConfig = multiview_geometry.TriangulationConfig()
    subpixel: subpixel.SubpixelConfig = subpixel.SubpixelConfig()
    min_points: int = 15  # points that a model needs
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
class FinalModel:
    """A model after its last adjustment."""

    model: SparseModel
    loss: bundle_adjustment.BundleAdjustmentConfig  # of that adjustment
    rms_px: float  # of the observations' errors, pixels at REFERENCE_SIDE


def run_final_adjustment(
    problem: MapperInput, partial: SparseModel, images: Sequence[PatchImage], config: FinalAdjustmentConfig
) -> FinalModel | None:
    """The model of the final tracks, adjusted until it has settled, or None when too few points are left.

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
                partial = _fit_lens_priors(problem, _adjust_and_filter(problem, partial, config), config)
    loss, errors = _loss(problem, partial.estimate, config), _errors(problem, partial.estimate)
    return FinalModel(partial, loss, float(np.sqrt(np.mean(errors**2))))


def _adjust_final_tracks(
    problem: MapperInput, partial: SparseModel, tolerance: float, config: FinalAdjustmentConfig
) -> SparseModel:
    """The model after an adjustment to the final tracks, its lenses held by what it found of them."""
    loss = _loss(problem, partial.estimate, config)
    adjusted = adjust(problem, partial, problem.final_tracks, loss, tolerance, config.triangulation)
    return _fit_lens_priors(problem, adjusted, config)


def _free_lenses(
    problem: MapperInput, prior: bundle_adjustment.LensPrior, config: FinalAdjustmentConfig
) -> bundle_adjustment.LensPrior:
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


def _fit_lens_priors(problem: MapperInput, partial: SparseModel, config: FinalAdjustmentConfig) -> SparseModel:
    """The model with priors under which distortion and displacement are as likely as they were found.

    A prior as wide as what is found lets a parameter stay where observations tell it to within half of what it is;
    any other falls, adjustment by adjustment, to where `config` holds it (MacKay, "Bayesian interpolation", 1992).
    """
    found = np.maximum(np.abs(partial.estimate.radials), config.radial_sigma)
    radial_sigmas = np.where(partial.prior.radial_sigmas > 0, found, 0.0)
    widest = np.array([lens.widest_shift for lens in problem.lenses])
    shifts = np.sqrt((partial.estimate.shifts**2).mean(1))
    least = config.shift_sigma * _longer_sides(problem)
    shift_sigmas = np.where(widest > 0, np.clip(shifts, least, np.maximum(widest, least)), partial.prior.shift_sigmas)
    return replace(partial, prior=replace(partial.prior, radial_sigmas=radial_sigmas, shift_sigmas=shift_sigmas))


def _find_distorting_lenses(problem: MapperInput, estimate: bundle_adjustment.Problem) -> Flags:
    """(G,) the lenses whose distortion moves the corners of their pictures by more than LEAST_SHIFT."""
    focals = np.exp(estimate.log_focals) / _longer_sides(problem)
    corners = CORNER / focals
    return np.abs(distortion(corners**2, estimate.radials) - 1.0) * corners * focals > LEAST_SHIFT


def _free_second_radial(partial: SparseModel, lenses: Flags) -> SparseModel:
    """The model with the second coefficient free of those of the `lenses` (G,) whose first one is."""
    sigmas = partial.prior.radial_sigmas.copy()
    sigmas[lenses & (sigmas[:, 0] > 0), 1] = _WIDEST_RADIAL
    return replace(partial, prior=replace(partial.prior, radial_sigmas=sigmas))


def _loss(
    problem: MapperInput, estimate: bundle_adjustment.Problem, config: FinalAdjustmentConfig
) -> bundle_adjustment.BundleAdjustmentConfig:
    """The scale of the robust loss and the noise of an observation, from the residuals."""
    scale = float(np.median(problem.scale))
    if len(estimate.points) == 0:
        return bundle_adjustment.BundleAdjustmentConfig(robust_px=scale * config.robust_range_px[1])
    median = float(np.median(_errors(problem, estimate)))
    noise_px = bundle_adjustment.noise_px(len(estimate.pixels), len(estimate.points), median)
    return bundle_adjustment.BundleAdjustmentConfig(
        robust_px=scale * float(np.clip(_ROBUST_PER_MEDIAN * median, *config.robust_range_px)),
        noise_px=scale * noise_px * float(np.sqrt(config.correlated)),
    )


def _adjust_and_filter(problem: MapperInput, partial: SparseModel, config: FinalAdjustmentConfig) -> SparseModel:
    """The model after a bundle adjustment, without observations with large errors and points with fewer than two."""
    loss = _loss(problem, partial.estimate, config)
    estimate = bundle_adjustment.adjust(partial.estimate, partial.prior, loss, partial.registered[0])
    good = _errors(problem, estimate) < config.triangulation.max_error_px
    filtered = bundle_adjustment.keep_observations(estimate, good)
    return replace(partial, estimate=filtered if _has_enough_observations(filtered, partial.registered) else estimate)


def _has_enough_observations(estimate: bundle_adjustment.Problem, registered: Sequence[int]) -> bool:
    """Whether every registered camera has enough observations for its pose, or a given pose that holds it."""
    enough = np.bincount(estimate.camera_of, minlength=len(estimate.rotations)) >= _MIN_OBSERVATIONS
    if estimate.given is not None:
        enough |= estimate.given.is_held
    return bool(enough[list(registered)].all())


def _errors(problem: MapperInput, estimate: bundle_adjustment.Problem) -> Array:
    """(O,) reprojection errors, pixels at REFERENCE_SIDE."""
    return bundle_adjustment.reprojection_errors(estimate) / problem.scale[estimate.camera_of]


_MAX_SPLITS = 4  # rounds in which views get lenses of their own
_MAX_DOUBTED = 8  # views for which other focal lengths are tried at once
# Of the focal length, and of the longer side for the principal point: an own lens that comes out nearer to the common
# one is none, for those that are tried are at least 7 times as far from it
_SAME_LENS = 0.01
_DOUBTED_RATIO = 0.9  # inlier ratio of a view below which other focal lengths are tried for it
_COARSE_PX, _COARSE_ROBUST_PX = 1.0, 4.0  # noise and scale of the robust loss of a coarse search, at REFERENCE_SIDE
# Ratio of the median errors of two models, from which on they explain the matches as well as each other, and nearly so
_AS_WELL, _NEARLY = 0.97, 0.9
# Difference of log focals from which on a lens is far from a typical one, and from what its pairs vote for
_FAR_FROM_TYPICAL, _FAR_FROM_VOTE = 0.5, 0.3
_HELD_SIGMA = 0.15  # of log focal, while such a focal length is held
_OTHER_ATTEMPTS = 3  # first pairs that are tried with it, or with a lens for each view
_APART = 0.1  # difference of log focals from which on views have a lens each
_UNEXPLAINED_BY_PLANE = 1.05  # less the planar share of a pair: above 1, so that a planar pair is better than none


class MapperConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The model of few views: attempts with several first pairs and focal lengths, of which the best is kept."""

    incremental: IncrementalMapperConfig = IncrementalMapperConfig()
    finishing: FinalAdjustmentConfig = FinalAdjustmentConfig()
    max_growing_tracks: int = 350  # tracks of a view, while views are added; more take time and change no decision
    max_final_tracks: int = 1500  # tracks of a view, in the last adjustment
    max_attempts: int = 6  # combinations of first pair and focal length that are tried
    score_px: float = 1.25  # error from which on a match scores 0, pixels at REFERENCE_SIDE
    same_rotation_deg: float = 0.5  # largest rotation between the views of two attempts that found the same model
    same_focal: float = 0.02  # largest difference of the log focals of two such attempts
    own_lenses: self_calibration.OwnLensesConfig = self_calibration.OwnLensesConfig()


@dataclass(frozen=True, eq=False)
class MapperResult:
    """Registered views and points. `estimate` has all views of the problem as cameras; only `views` are valid."""

    views: tuple[int, ...]  # the registered ones; the first is the camera that adjustments fixed
    estimate: bundle_adjustment.Problem
    prior: bundle_adjustment.LensPrior
    loss: bundle_adjustment.BundleAdjustmentConfig
    inlier_ratios: dict[Pair, float]  # the share of each pair's matches that agree with the poses
    median_angle_deg: float  # of the points' triangulation angles
    rms_px: float  # of the observations' errors, pixels at REFERENCE_SIDE
    num_common: int  # lenses that views were taken to share: those from this number on are of single views

    def relabel(self, number: Sequence[int]) -> MapperResult:
        """The same model with the views relabelled: new = number[old], a permutation."""
        old, new = np.argsort(number), np.asarray(number)
        relabelled = replace(
            self.estimate,
            rotations=self.estimate.rotations[old],
            translations=self.estimate.translations[old],
            lens_of_camera=self.estimate.lens_of_camera[old],
            given=None if self.estimate.given is None else self.estimate.given.relabel(old),
            rig=None if self.estimate.rig is None else self.estimate.rig.relabel(old),
            camera_of=new[self.estimate.camera_of],
        )
        ratios = {
            (int(min(new[i], new[j])), int(max(new[i], new[j]))): ratio for (i, j), ratio in self.inlier_ratios.items()
        }
        return replace(
            self,
            views=tuple(int(new[view]) for view in self.views),
            estimate=relabelled,
            inlier_ratios=dict(sorted(ratios.items())),
        )


def build_model(
    views: Sequence[MapperView],
    lenses: Sequence[Lens],
    pairs: Pairs,
    config: MapperConfig,
    images: Sequence[PatchImage] = (),
    run: RunContext = BACKGROUND,
) -> MapperResult | None:
    """The best model of several attempts, or None when no two views can be registered.

    `images`, one a view, make its observations exact to a tenth of a pixel. It pauses between attempts, which may
    raise to abandon the work.
    """
    problem = mapping_problem.prepare(views, lenses, pairs, config.max_growing_tracks, config.max_final_tracks)
    attempts: list[tuple[float, SparseModel]] = []
    for attempt in _attempt_models(problem, config.max_attempts, config, run):
        found_again = bool(attempts) and _is_same_model(max(attempts, key=itemgetter(0))[1], attempt[1], config)
        attempts.append(attempt)
        if found_again and len(attempt[1].registered) == len(views):
            break
    found = _finish_best(problem, attempts, images, config, run)
    if found is None:
        return None
    found = _try_other_focal_lengths(problem, found, images, config, run)
    found = _try_lenses_of_views(problem, found, images, config, run)
    return make_result(*found, config.incremental.triangulation.max_error_px, len(lenses))


def _attempt_models(
    problem: MapperInput, limit: int, config: MapperConfig, run: RunContext
) -> Iterator[tuple[float, SparseModel]]:
    """Models of at most `limit` first pairs and focal lengths, the likeliest first, with their scores."""
    for first, focals in _starts(problem.lenses, problem.pairs, limit):
        run.pause()
        partial = grow(problem, focals, first, config.incremental)
        if partial is not None:
            yield score(problem, partial, config.score_px), partial


def _finish_best(
    problem: MapperInput,
    attempts: Sequence[tuple[float, SparseModel]],
    images: Sequence[PatchImage],
    config: MapperConfig,
    run: RunContext,
) -> tuple[MapperInput, FinalModel] | None:
    """The best attempt after its last adjustment, with own lenses for its views; None where nothing is left of it."""
    if not attempts:
        return None
    run.pause()
    best = max(attempts, key=itemgetter(0))[1]
    coherent = mapping_problem.drop_repeated_structures(
        problem, best, config.max_growing_tracks, config.max_final_tracks
    )
    if coherent is not problem:
        problem, best = coherent, adjust_quickly(coherent, best, SETTLED_TOLERANCE, config.incremental)
    finished = run_final_adjustment(problem, best, images, config.finishing)
    return None if finished is None else give_own_lenses(problem, finished, images, config, run)


def _try_other_focal_lengths(
    problem: MapperInput,
    found: tuple[MapperInput, FinalModel],
    images: Sequence[PatchImage],
    config: MapperConfig,
    run: RunContext,
) -> tuple[MapperInput, FinalModel]:
    """Both as `problem` gives them from other focal lengths, where lenses came out far from these and it fits better.

    Images with slightly different lenses can pass for images through one lens that is much longer, which no small
    change of that lens shows. The other focal lengths are held until images have lenses of their own.
    """
    for focals in _list_other_focals(problem, found[1].model.estimate.log_focals):
        run.pause()
        held = [
            lens if focal is None else replace(lens, focals=(focal,), sigma=_HELD_SIGMA)
            for lens, focal in zip(problem.lenses, focals, strict=True)
        ]
        started = replace(problem, lenses=tuple(held))
        attempts = list(_attempt_models(started, _OTHER_ATTEMPTS, config, run))
        other = _finish_best(started, attempts, images, config, run)
        if other is None:
            continue
        sigmas = other[1].model.prior.sigmas.copy()
        sigmas[: len(held)] = [lens.sigma for lens in problem.lenses]
        free = replace(other[1].model, prior=replace(other[1].model.prior, sigmas=sigmas))
        finished = run_final_adjustment(other[0], free, images, config.finishing)
        if finished is None:
            continue
        found = _choose_better(found, (other[0], finished), config)
    return found


def _try_lenses_of_views(
    problem: MapperInput,
    found: tuple[MapperInput, FinalModel],
    images: Sequence[PatchImage],
    config: MapperConfig,
    run: RunContext,
) -> tuple[MapperInput, FinalModel]:
    """Both with a lens for each of three views from the beginning, where pairs alone fit better, and this model does.

    Few views let a common lens bend a model so far that no search from it finds their lenses. What fundamental
    matrices explain more than the model tells whether there are better ones.
    """
    if len(problem.views) != _FEW_VIEWS or len(problem.lenses) == len(problem.views):
        return found
    zeros = {pair: config.score_px * float(problem.scale[pair[0]]) for pair in problem.pairs}
    alone = sum(count_explained(fit_epipolar_errors(problem.pairs[k], zeros[k]), zeros[k]) for k in zeros)
    if alone * _AS_WELL <= score(found[0], found[1].model, config.score_px):
        return found
    run.pause()
    apart = self_calibration.separate_views(problem)
    other = _finish_best(apart, list(_attempt_models(apart, _OTHER_ATTEMPTS, config, run)), images, config, run)
    if other is None or not _has_lenses_apart(problem, other[1].model):
        return found
    return _choose_better(found, other, config)


def _has_lenses_apart(problem: MapperInput, partial: SparseModel) -> bool:
    """Whether focal lengths of a model with a lens each differ among views that `problem` has one lens for."""
    log_focals = partial.estimate.log_focals[partial.estimate.lens_of_camera]
    groups = [[v for v in partial.registered if problem.views[v].lens == lens] for lens in range(len(problem.lenses))]
    return any(np.ptp(log_focals[group]) > _APART for group in groups if group)


def _choose_better(
    found: tuple[MapperInput, FinalModel], other: tuple[MapperInput, FinalModel], config: MapperConfig
) -> tuple[MapperInput, FinalModel]:
    """The other one of two models where it explains clearly more of the matches."""
    before, after = (score(each[0], each[1].model, config.score_px) for each in (found, other))
    return other if after * _AS_WELL > before else found


def _list_other_focals(problem: MapperInput, log_focals: Array) -> list[list[float | None]]:
    """Focal lengths in pixels to be tried besides, one a lens; None for a lens that keeps its own."""
    typical = [lens.typical for lens in problem.lenses]
    voted = [None if lens.typical is None else lens.focals[0] for lens in problem.lenses]
    tried: list[list[float | None]] = []
    for others, limit in ((voted, _FAR_FROM_VOTE), (typical, _FAR_FROM_TYPICAL)):
        focals = [
            focal if focal is not None and abs(log_focal - np.log(focal)) > limit else None
            for focal, log_focal in zip(others, log_focals[: len(others)], strict=True)
        ]
        if any(focal is not None for focal in focals) and focals not in tried:
            tried.append(focals)
    return tried


def give_own_lenses(
    problem: MapperInput,
    finished: FinalModel,
    images: Sequence[PatchImage],
    config: MapperConfig,
    run: RunContext = BACKGROUND,
) -> tuple[MapperInput, FinalModel]:
    """Both, with lenses of their own for the views that refute the common one, or with pixels that are not square.

    Each can pass for the other in part. Where another aspect alone explains much, the model is continued from it, too,
    and the one that explains the matches better is kept; as well with fewer lenses is better, too. Where it explains
    them nearly as well with fewer lenses, the aspect counts as unknown.
    """
    own = _separate_lenses(problem, finished, images, config, run)
    stretched = self_calibration.free_aspects(finished.model, finished.loss, config.own_lenses)
    if stretched is None:
        problem, stretched = own[0], self_calibration.free_aspects(own[1].model, own[1].loss, config.own_lenses)
    if stretched is None:
        return own
    if len(stretched.registered) < len(problem.views):
        # The last adjustment has dropped points: those of the tracks are triangulated anew.
        stretched = adjust_quickly(problem, stretched, SETTLED_TOLERANCE, config.incremental)
        stretched = extend(problem, stretched, config.incremental)
    again = run_final_adjustment(problem, stretched, images, config.finishing)
    if again is None:
        return own
    other = _separate_lenses(problem, again, images, config, run)
    return _choose_aspect(own, other, config)


def _choose_aspect(
    own: tuple[MapperInput, FinalModel], other: tuple[MapperInput, FinalModel], config: MapperConfig
) -> tuple[MapperInput, FinalModel]:
    """The one of two models that explains the matches better; `other` has pixels that are not square: rare ones."""
    if not self_calibration.is_stretched(other[1].model, config.own_lenses):
        return own
    before, after = (mapping_problem.compute_median_error(problem, found.model) for problem, found in (own, other))
    simpler = len(other[0].lenses) < len(own[0].lenses)  # an aspect that does what several lenses do is no chance
    if after < before / _AS_WELL if simpler else after < before * _NEARLY:
        return other
    if simpler and after < before / _NEARLY:
        prior = self_calibration.free_aspect_prior(own[1].model, config.own_lenses)
        return own[0], replace(own[1], model=replace(own[1].model, prior=prior))
    return own


def _separate_lenses(
    problem: MapperInput,
    finished: FinalModel,
    images: Sequence[PatchImage],
    config: MapperConfig,
    run: RunContext,
) -> tuple[MapperInput, FinalModel]:
    """Both, with lenses of their own for the views that refute the common one.

    First for views that hardly fit and fit better with another focal length, then for those whose observations say so.
    """
    searches = [_try_other_focals, _try_coarse_lenses]
    for _ in range(_MAX_SPLITS):
        run.pause()
        before = finished
        for search in searches if _find_doubtful_views(problem, finished.model, config) else ():
            found = search(problem, finished.model, images, config)
            if found is None:
                continue
            if score(found[0], found[1].model, config.score_px) > score(problem, finished.model, config.score_px):
                problem, finished = found
        searches = [_try_other_focals]
        problem, finished = _split_refuted_lenses(problem, finished, images, config)
        if finished is before:
            break
    return problem, finished


def _split_refuted_lenses(
    problem: MapperInput, finished: FinalModel, images: Sequence[PatchImage], config: MapperConfig
) -> tuple[MapperInput, FinalModel]:
    """Both, with own lenses for the views that refute theirs; of another shape where none without explains as much."""
    found, num_views = (problem, finished), len(finished.model.registered)
    for shapes in (False, True) if num_views >= self_calibration.FEWEST_FOR_SHAPES else (False,):
        freed = self_calibration.free_lenses(problem, finished.model, finished.loss, config.own_lenses, shapes=shapes)
        if not freed.refutes:
            continue
        apart, partial = self_calibration.split_lenses(problem, finished.model, freed, config.own_lenses)
        again = run_final_adjustment(apart, partial, images, config.finishing)
        if again is not None and (found[1] is finished or _has_smaller_errors((apart, again), found)):
            found = apart, again
    return found


def _has_smaller_errors(one: tuple[MapperInput, FinalModel], other: tuple[MapperInput, FinalModel]) -> bool:
    errors = [mapping_problem.compute_median_error(problem, found.model) for problem, found in (one, other)]
    return errors[0] < _AS_WELL * errors[1]


def _find_doubtful_views(problem: MapperInput, partial: SparseModel, config: MapperConfig) -> list[int]:
    """The views that are not registered, or whose matches hardly fit; those first that fit least."""
    ratios = mapping_problem.inlier_ratios(problem, partial, config.incremental.triangulation.max_error_px)
    of_view = {
        view: mapping_problem.compute_pooled_ratio(ratios, problem.pairs, view) if view in partial.registered else 0.0
        for view in range(len(problem.views))
    }
    return sorted((view for view in of_view if of_view[view] < _DOUBTED_RATIO), key=lambda view: (of_view[view], view))


def _try_coarse_lenses(
    problem: MapperInput, partial: SparseModel, images: Sequence[PatchImage], config: MapperConfig
) -> tuple[MapperInput, FinalModel] | None:
    """Both, with own lenses as a coarse search finds them; None where it finds none."""
    scale = float(np.median(problem.scale))
    noise_px = scale * _COARSE_PX * float(np.sqrt(config.finishing.correlated))
    loss = bundle_adjustment.BundleAdjustmentConfig(robust_px=scale * _COARSE_ROBUST_PX, noise_px=noise_px)
    freed = self_calibration.free_lenses(problem, partial, loss, config.own_lenses, config.incremental.triangulation)
    if not freed.refutes:
        return None
    problem, partial = self_calibration.split_lenses(problem, partial, freed, config.own_lenses)
    return _finish_model(problem, partial, images, config)


def _finish_model(
    problem: MapperInput, partial: SparseModel, images: Sequence[PatchImage], config: MapperConfig
) -> tuple[MapperInput, FinalModel] | None:
    partial = adjust_quickly(problem, partial, SETTLED_TOLERANCE, config.incremental)
    if len(partial.estimate.points) < config.incremental.min_points:
        return None
    finished = run_final_adjustment(problem, extend(problem, partial, config.incremental), images, config.finishing)
    return None if finished is None else (problem, finished)


def _try_other_focals(
    problem: MapperInput, partial: SparseModel, images: Sequence[PatchImage], config: MapperConfig
) -> tuple[MapperInput, FinalModel] | None:
    """Both, with other focal lengths for views that hardly fit or do not at all; None where no other one fits.

    None, too, where all of these lenses come out as the common one: then wrong matches are why the views hardly fit.
    """
    zoomed = _find_other_focals(problem, partial, config)
    if not zoomed or len(set(partial.registered) - zoomed.keys()) < 2:
        return None
    common, registered = partial.estimate.lens_of_camera, partial.registered
    for view, lens in zoomed.items():
        problem, partial = self_calibration.add_lens(problem, partial, view, lens.focal, lens.shift)
    found = _finish_model(problem, partial, images, config)
    if found is None or all(v in registered and _is_same_lens(*found, v, int(common[v])) for v in zoomed):
        return None
    return found


def _find_other_focals(problem: MapperInput, partial: SparseModel, config: MapperConfig) -> dict[int, OwnLens]:
    zoomed = {}
    for view in _find_doubtful_views(problem, partial, config)[:_MAX_DOUBTED]:
        # Points that the view helped to place where it does not belong must not speak for it.
        registered = tuple(each for each in partial.registered if each != view)
        if len(registered) < 2:
            continue
        rest = replace(partial, registered=registered)
        rest = adjust_quickly(problem, rest, SETTLED_TOLERANCE, config.incremental)
        if len(rest.estimate.points) < config.incremental.min_points:
            continue
        lens = mapping_problem.find_own_lens(problem, rest, view, config.incremental.resection)
        if lens is not None:
            zoomed[view] = lens
    return zoomed


def _is_same_lens(problem: MapperInput, finished: FinalModel, view: int, common: int) -> bool:
    """Whether a view's own lens has come out as the common one."""
    estimate = finished.model.estimate
    own = estimate.lens_of_camera[view]
    apart_px = float(np.linalg.norm(estimate.shifts[own] - estimate.shifts[common]))
    same_focal = abs(estimate.log_focals[own] - estimate.log_focals[common]) < _SAME_LENS
    return bool(
        view in finished.model.registered and same_focal and apart_px < _SAME_LENS * problem.views[view].longer_side
    )


def _is_same_model(one: SparseModel, other: SparseModel, config: MapperConfig) -> bool:
    """Whether two attempts registered the same views with the same poses and focal lengths."""
    if set(one.registered) != set(other.registered):
        return False
    rotation_deg, log_focal = mapping_problem.difference(one, other)
    return rotation_deg < config.same_rotation_deg and log_focal < config.same_focal


def _starts(lenses: Sequence[Lens], pairs: Pairs, limit: int) -> list[tuple[Pair, list[float]]]:
    """First pairs with focal lengths (one a lens), the likeliest of both first."""
    first = _first_pairs(pairs)
    num_focals = max(len(lens.focals) for lens in lenses)
    focals = [[lens.focals[min(choice, len(lens.focals) - 1)] for lens in lenses] for choice in range(num_focals)]
    order = sorted(itertools.product(range(len(first)), range(num_focals)), key=lambda ranks: (sum(ranks), ranks[0]))
    return [(first[pair], focals[choice]) for pair, choice in order[:limit]]


def _first_pairs(pairs: Pairs) -> list[Pair]:
    """The pairs, those first that have many matches which neither a plane nor a rotation explains."""

    def strength(key: Pair) -> float:
        pair = pairs[key]
        count = len(pair.matches)
        degenerate = min(1.0, max(pair.num_homography, pair.num_rotation) / count)
        return count * (_UNEXPLAINED_BY_PLANE - degenerate) ** 0.5

    return sorted(pairs, key=lambda key: (-strength(key), key))


def make_result(problem: MapperInput, finished: FinalModel, max_error_px: float, num_common: int) -> MapperResult:
    """The finished model with its quality; matches up to `max_error_px`, at REFERENCE_SIDE, are inliers."""
    partial, estimate = finished.model, finished.model.estimate
    angles = multiview_geometry.largest_angles(
        bundle_adjustment.centres(estimate), estimate.points, estimate.camera_of, estimate.point_of
    )
    return MapperResult(
        views=partial.registered,
        estimate=estimate,
        prior=partial.prior,
        loss=finished.loss,
        inlier_ratios=mapping_problem.inlier_ratios(problem, partial, max_error_px),
        median_angle_deg=float(np.median(angles)) if len(angles) else 0.0,
        rms_px=finished.rms_px,
        num_common=num_common,
    )
