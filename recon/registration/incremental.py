"""Incremental mapping: a first pair, then one view after the other, with a bundle adjustment after each."""

from __future__ import annotations

import functools
from dataclasses import replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle, epipolar, inliers, resection, triangulation
from splatnode.recon.registration.mapping_problem import MapperInput, Pair, PartialMap
from splatnode.recon.registration.resection import Resection
from splatnode.recon.registration.tracks import Tracks
from splatnode.recon.workers import map_parallel

Array = npt.NDArray[np.float64]

# The less is settled, the larger errors may be, as multiples of `triangulation.max_error_px`, for a point to be kept:
_FIRST_PAIR_TOLERANCE = 4.0  # with two views and a guessed focal length
_NEW_VIEW_TOLERANCE = 3.0  # with a view that has just been resected
SETTLED_TOLERANCE = 2.0  # with views that have been adjusted before

# A bundle adjustment after each view need not converge: the next view changes the map again.
_QUICK_ITERATIONS, _QUICK_DECREASE = 10, 1e-3

_MIN_IMPROVEMENT = 1.05  # factor of the score by which another map must be better to replace one
_MIN_VIEWS = 3  # that must stay when doubtful ones are removed


class IncrementalMapperConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    resection: resection.ResectionConfig = resection.ResectionConfig()
    triangulation: triangulation.TriangulationConfig = triangulation.TriangulationConfig()
    robust_px: float = 1.0  # scale of the robust loss, pixels at REFERENCE_SIDE
    min_points: int = 15  # points that a map needs
    candidates: int = 3  # views that are resected before the best of them is registered
    min_view_ratio: float = 0.6  # inlier ratio of a view's matches below which it is removed and resected again
    # Standard deviation of log focal while there are two views, which say little about it
    pair_focal_sigma: float = 0.03


def grow(problem: MapperInput, focals: list[float], first: Pair, config: IncrementalMapperConfig) -> PartialMap | None:
    """A map from the pair `first` on, with every view that can be registered; None where the pair gives too little.

    `focals` (one a lens) are in pixels.
    """
    partial = _initialise(problem, focals, first, config)
    return _repair(problem, extend(problem, partial, config), config) if partial else None


def score(problem: MapperInput, partial: PartialMap, zero_px: float) -> float:
    """The number of matches that the map explains, of all pairs; one with error e counts 1 - (e / zero_px)^2.

    `zero_px` is in pixels at REFERENCE_SIDE; matches with larger errors count 0.
    """
    errors = inliers.pair_errors(problem, partial).values()
    return sum(float(np.maximum(0.0, 1.0 - (of_pair / zero_px) ** 2).sum()) for of_pair in errors)


def adjust(
    problem: MapperInput,
    partial: PartialMap,
    tracks: Tracks,
    loss: bundle.BundleAdjustmentConfig,
    tolerance: float,
    config: triangulation.TriangulationConfig,
) -> PartialMap:
    """The map with all points triangulated anew (see `retriangulate` for `tolerance`), then bundle-adjusted."""
    estimate, track_of_point = triangulation.retriangulate(
        partial.estimate, tracks, partial.registered, problem.scale, config, tolerance
    )
    if len(estimate.points):
        estimate = bundle.adjust(estimate, partial.prior, loss, partial.registered[0])
    return replace(partial, estimate=estimate, track_of_point=track_of_point)


def adjust_quickly(
    problem: MapperInput, partial: PartialMap, tolerance: float, config: IncrementalMapperConfig
) -> PartialMap:
    """`adjust` with few tracks and few iterations, for after each view."""
    robust_px = config.robust_px * float(np.median(problem.scale))
    loss = bundle.BundleAdjustmentConfig(
        robust_px=robust_px, max_iterations=_QUICK_ITERATIONS, tolerance=_QUICK_DECREASE
    )
    return adjust(problem, partial, problem.growing_tracks, loss, tolerance, config.triangulation)


def _initialise(
    problem: MapperInput, focals: list[float], first: Pair, config: IncrementalMapperConfig
) -> PartialMap | None:
    """The map of the pair `first`: its first view is the world's origin, its baseline the unit of length."""
    count = len(problem.views)
    rotation, direction, num_inliers = epipolar.relative_pose(
        problem.pairs[first],
        focals[problem.views[first[0]].lens],
        focals[problem.views[first[1]].lens],
        config.triangulation.max_error_px * float(problem.scale[first[0]]),
    )
    if num_inliers < config.min_points:
        return None
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    rotations[first[1]], translations[first[1]] = rotation, direction
    estimate = bundle.make_empty_problem(
        rotations=rotations,
        translations=translations,
        lens_of_camera=np.array([view.lens for view in problem.views]),
        log_focals=np.log(focals),
        radials=np.array([lens.radial for lens in problem.lenses]),
        shifts=np.zeros((len(problem.lenses), 2)),
    )
    prior = bundle.focal_prior(np.log(focals), np.array([lens.sigma for lens in problem.lenses]))
    tight = replace(prior, sigmas=np.minimum(prior.sigmas, config.pair_focal_sigma))
    start = PartialMap(first, estimate, tight, np.zeros(0, np.int64))
    partial = adjust_quickly(problem, start, _FIRST_PAIR_TOLERANCE, config)
    return replace(partial, prior=prior) if len(partial.estimate.points) >= config.min_points else None


def extend(problem: MapperInput, partial: PartialMap, config: IncrementalMapperConfig) -> PartialMap:
    """The map with every further view that can be registered.

    Of the views that observe most of the map, the one with the highest inlier ratio comes next: a view that repeated
    structures misplace contradicts some of its neighbours, and waits until more of them are registered.
    """
    failed: set[int] = set()
    while len(partial.registered) + len(failed) < len(problem.views):
        candidates = _next_views(problem, partial, failed)[: config.candidates]
        resect = functools.partial(resection.resect, problem, partial, config=config.resection)
        tried = dict(zip(candidates, map_parallel(resect, candidates), strict=True))
        found: dict[int, Resection] = {view: resected for view, resected in tried.items() if resected is not None}
        failed |= tried.keys() - found.keys()
        if not found:
            continue
        best = max(found, key=lambda view: (found[view].inlier_ratio, -view))
        estimate = bundle.replace_pose(partial.estimate, best, found[best].rotation, found[best].translation)
        larger = replace(partial, estimate=estimate, registered=(*partial.registered, best))
        partial = adjust_quickly(problem, larger, _NEW_VIEW_TOLERANCE, config)
        failed.clear()  # The new view brings new points, from which others may now be resected.
    return partial


def _next_views(problem: MapperInput, partial: PartialMap, failed: set[int]) -> list[int]:
    """The views that are not registered and have not failed; those that observe most of the map's points first."""
    tracks = problem.growing_tracks
    in_map = np.isin(tracks.track_of, partial.track_of_point)
    counts = np.bincount(tracks.camera_of[in_map], minlength=len(problem.views))
    waiting = [view for view in range(len(problem.views)) if view not in partial.registered and view not in failed]
    return sorted(waiting, key=lambda view: (-counts[view], view))


def _repair(problem: MapperInput, partial: PartialMap, config: IncrementalMapperConfig) -> PartialMap:
    """The map after views with low inlier ratios have been removed and resected, where that raises the score.

    First all of them at once, because misplaced views may support each other; then one after the other.
    """
    doubtful = _find_doubtful_views(problem, partial, config)
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


def _find_doubtful_views(problem: MapperInput, partial: PartialMap, config: IncrementalMapperConfig) -> list[int]:
    """The registered views with an inlier ratio below `min_view_ratio`, the lowest first."""
    ratios = inliers.inlier_ratios(problem, partial, config.triangulation.max_error_px)
    of_view = {view: inliers.compute_pooled_ratio(ratios, problem.pairs, view) for view in partial.registered}
    return sorted((view for view in of_view if of_view[view] < config.min_view_ratio), key=lambda view: of_view[view])
