"""The map of few views: attempts with several first pairs and focal lengths, of which the best is kept.

With a handful of views there is time to try. Attempts are scored by ALL pairwise matches, those included that a map was
not built from.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from splatnode.recon.registration import (
    bundle,
    finishing,
    incremental,
    inliers,
    mapping_problem,
    own_lenses,
    resection,
    triangulation,
)
from splatnode.recon.registration.mapping_problem import Lens, MapperInput, MapperView, Pair, Pairs, PartialMap
from splatnode.recon.registration.patch_image import PatchImage

_MAX_SPLITS = 4  # rounds in which views get lenses of their own
_MAX_DOUBTED = 8  # views for which other focal lengths are tried at once
_DOUBTED_RATIO = 0.9  # inlier ratio of a view below which other focal lengths are tried for it
_COARSE_PX, _COARSE_ROBUST_PX = 1.0, 4.0  # noise and scale of the robust loss of a coarse search, at REFERENCE_SIDE
_UNEXPLAINED_BY_PLANE = 1.05  # less the planar share of a pair: above 1, so that a planar pair is better than none


class MapperConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    incremental: incremental.IncrementalMapperConfig = incremental.IncrementalMapperConfig()
    finishing: finishing.FinalAdjustmentConfig = finishing.FinalAdjustmentConfig()
    max_growing_tracks: int = 350  # tracks of a view, while views are added; more take time and change no decision
    max_final_tracks: int = 1500  # tracks of a view, in the last adjustment
    max_attempts: int = 6  # combinations of first pair and focal length that are tried
    score_px: float = 1.25  # error from which on a match scores 0, pixels at REFERENCE_SIDE
    same_rotation_deg: float = 0.5  # largest rotation between the views of two attempts that found the same map
    same_focal: float = 0.02  # largest difference of the log focals of two such attempts
    own_lenses: own_lenses.OwnLensesConfig = own_lenses.OwnLensesConfig()


@dataclass(frozen=True, eq=False)
class Map:
    """Registered views and points. `estimate` has all views of the problem as cameras; only `views` are valid."""

    views: tuple[int, ...]  # the registered ones; the first is the camera that adjustments fixed
    estimate: bundle.Problem
    prior: bundle.LensPrior
    loss: bundle.BundleAdjustmentConfig
    inlier_ratios: dict[Pair, float]  # the share of each pair's matches that agree with the poses
    median_angle_deg: float  # of the points' triangulation angles
    rms_px: float  # of the observations' errors, pixels at REFERENCE_SIDE
    num_common: int  # lenses that views were taken to share: those from this number on are of single views

    def relabel(self, number: Sequence[int]) -> Map:
        """The same map with the views relabelled: new = number[old], a permutation."""
        old, new = np.argsort(number), np.asarray(number)
        relabelled = replace(
            self.estimate,
            rotations=self.estimate.rotations[old],
            translations=self.estimate.translations[old],
            lens_of_camera=self.estimate.lens_of_camera[old],
            given=None if self.estimate.given is None else self.estimate.given.relabel(old),
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


def build_map(
    views: Sequence[MapperView],
    lenses: Sequence[Lens],
    pairs: Pairs,
    config: MapperConfig,
    images: Sequence[PatchImage] = (),
    pause: Callable[[], None] = lambda: None,
) -> Map | None:
    """The best map of several attempts, or None when no two views can be registered.

    `images`, one a view, make its observations exact to a tenth of a pixel. `pause` is called between attempts and may
    raise to abandon the work.
    """
    problem = mapping_problem.prepare(views, lenses, pairs, config.max_growing_tracks, config.max_final_tracks)
    attempts: list[tuple[float, PartialMap]] = []
    for first, focals in _starts(lenses, pairs, config.max_attempts):
        pause()
        partial = incremental.grow(problem, focals, first, config.incremental)
        if partial is None:
            continue
        found_again = bool(attempts) and _is_same_map(max(attempts, key=_score)[1], partial, config)
        attempts.append((incremental.score(problem, partial, config.score_px), partial))
        if found_again and len(partial.registered) == len(views):
            break
    if not attempts:
        return None
    pause()
    _, best = max(attempts, key=_score)
    finished = finishing.run_final_adjustment(problem, best, images, config.finishing)
    if finished is None:
        return None
    problem, finished = give_own_lenses(problem, finished, images, config, pause)
    return make_map(problem, finished, config.incremental.triangulation.max_error_px, len(lenses))


def give_own_lenses(
    problem: MapperInput,
    finished: finishing.FinalMap,
    images: Sequence[PatchImage],
    config: MapperConfig,
    pause: Callable[[], None] = lambda: None,
) -> tuple[MapperInput, finishing.FinalMap]:
    """Both, with lenses of their own for the views that refute the common one.

    First for views that hardly fit and fit better with another focal length, then for those whose observations say so.
    """
    searches = [_try_other_focals, _try_coarse_lenses]
    for _ in range(_MAX_SPLITS):
        pause()
        before = finished
        for search in searches if _find_doubtful_views(problem, finished.map, config) else ():
            found = search(problem, finished.map, config)
            again = None if found is None else finishing.run_final_adjustment(*found, images, config.finishing)
            if found is None or again is None:
                continue
            if _score_of(found[0], again.map, config) > _score_of(problem, finished.map, config):
                problem, finished = found[0], again
        searches = [_try_other_focals]
        freed = own_lenses.free_lenses(problem, finished.map, finished.loss, config.own_lenses)
        if freed.refuting_views.any() or freed.displaced.any():
            apart, partial = own_lenses.split_lenses(problem, finished.map, freed, config.own_lenses)
            again = finishing.run_final_adjustment(apart, partial, images, config.finishing)
            if again is not None:
                problem, finished = apart, again
        if finished is before:
            break
    return problem, finished


def _find_doubtful_views(problem: MapperInput, partial: PartialMap, config: MapperConfig) -> list[int]:
    """The views that are not registered, or whose matches hardly fit; those first that fit least."""
    ratios = inliers.inlier_ratios(problem, partial, config.incremental.triangulation.max_error_px)
    of_view = {
        view: inliers.compute_pooled_ratio(ratios, problem.pairs, view) if view in partial.registered else 0.0
        for view in range(len(problem.views))
    }
    return sorted((view for view in of_view if of_view[view] < _DOUBTED_RATIO), key=lambda view: (of_view[view], view))


def _try_coarse_lenses(
    problem: MapperInput, partial: PartialMap, config: MapperConfig
) -> tuple[MapperInput, PartialMap] | None:
    """Both, with own lenses as a coarse search finds them; None where it finds none."""
    scale = float(np.median(problem.scale))
    noise_px = scale * _COARSE_PX * float(np.sqrt(config.finishing.correlated))
    loss = bundle.BundleAdjustmentConfig(robust_px=scale * _COARSE_ROBUST_PX, noise_px=noise_px)
    freed = own_lenses.free_lenses(problem, partial, loss, config.own_lenses, config.incremental.triangulation)
    if not (freed.refuting_views.any() or freed.displaced.any()):
        return None
    problem, partial = own_lenses.split_lenses(problem, partial, freed, config.own_lenses)
    partial = incremental.adjust_quickly(problem, partial, incremental.SETTLED_TOLERANCE, config.incremental)
    if len(partial.estimate.points) < config.incremental.min_points:
        return None
    return problem, incremental.extend(problem, partial, config.incremental)


def _try_other_focals(
    problem: MapperInput, partial: PartialMap, config: MapperConfig
) -> tuple[MapperInput, PartialMap] | None:
    """Both, with other focal lengths for views that hardly fit or do not at all; None where no other one fits."""
    zoomed = {}
    for view in _find_doubtful_views(problem, partial, config)[:_MAX_DOUBTED]:
        # Points that the view helped to place where it does not belong must not speak for it.
        registered = tuple(each for each in partial.registered if each != view)
        if len(registered) < 2:
            continue
        rest = replace(partial, registered=registered)
        rest = incremental.adjust_quickly(problem, rest, incremental.SETTLED_TOLERANCE, config.incremental)
        if len(rest.estimate.points) < config.incremental.min_points:
            continue
        focal = resection.own_focal(problem, rest, view, config.incremental.resection)
        if focal is not None:
            zoomed[view] = focal
    if not zoomed or len(set(partial.registered) - zoomed.keys()) < 2:
        return None
    for view, focal in zoomed.items():
        problem, partial = own_lenses.add_lens(problem, partial, view, focal)
    partial = incremental.adjust_quickly(problem, partial, incremental.SETTLED_TOLERANCE, config.incremental)
    if len(partial.estimate.points) < config.incremental.min_points:
        return None
    return problem, incremental.extend(problem, partial, config.incremental)


def _score_of(problem: MapperInput, partial: PartialMap, config: MapperConfig) -> float:
    return incremental.score(problem, partial, config.score_px)


def _score(attempt: tuple[float, PartialMap]) -> float:
    return attempt[0]


def _is_same_map(one: PartialMap, other: PartialMap, config: MapperConfig) -> bool:
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


def make_map(problem: MapperInput, finished: finishing.FinalMap, max_error_px: float, num_common: int) -> Map:
    """The finished map with its quality; matches up to `max_error_px`, at REFERENCE_SIDE, are inliers."""
    partial, estimate = finished.map, finished.map.estimate
    angles = triangulation.largest_angles(
        bundle.centres(estimate), estimate.points, estimate.camera_of, estimate.point_of
    )
    return Map(
        views=partial.registered,
        estimate=estimate,
        prior=partial.prior,
        loss=finished.loss,
        inlier_ratios=inliers.inlier_ratios(problem, partial, max_error_px),
        median_angle_deg=float(np.median(angles)) if len(angles) else 0.0,
        rms_px=finished.rms_px,
        num_common=num_common,
    )
