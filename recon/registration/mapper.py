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

from splatnode.recon.registration import bundle, finishing, incremental, inliers, mapping_problem, triangulation
from splatnode.recon.registration.mapping_problem import Lens, MappingProblem, Pair, Pairs, PartialMap, View
from splatnode.recon.registration.patch_image import PatchImage

_UNEXPLAINED_BY_PLANE = 1.05  # less the planar share of a pair: above 1, so that a planar pair is better than none


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    incremental: incremental.Config = incremental.Config()
    finishing: finishing.Config = finishing.Config()
    max_growing_tracks: int = 350  # tracks of a view, while views are added; more take time and change no decision
    max_final_tracks: int = 1500  # tracks of a view, in the last adjustment
    max_attempts: int = 6  # combinations of first pair and focal length that are tried
    score_px: float = 1.25  # error from which on a match scores 0, pixels at REFERENCE_SIDE
    same_rotation_deg: float = 0.5  # largest rotation between the views of two attempts that found the same map
    same_focal: float = 0.02  # largest difference of the log focals of two such attempts


@dataclass(frozen=True, eq=False)
class Map:
    """Registered views and points. `estimate` has all views of the problem as cameras; only `views` are valid."""

    views: tuple[int, ...]  # the registered ones; the first is the camera that adjustments fixed
    estimate: bundle.Problem
    prior: bundle.LensPrior
    loss: bundle.Config
    inlier_ratios: dict[Pair, float]  # the share of each pair's matches that agree with the poses
    median_angle_deg: float  # of the points' triangulation angles
    rms_px: float  # of the observations' errors, pixels at REFERENCE_SIDE

    def relabelled(self, number: Sequence[int]) -> Map:
        """The same map with the views relabelled: new = number[old], a permutation."""
        old, new = np.argsort(number), np.asarray(number)
        relabelled = replace(
            self.estimate,
            rotations=self.estimate.rotations[old],
            translations=self.estimate.translations[old],
            lens_of_camera=self.estimate.lens_of_camera[old],
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
    views: Sequence[View],
    lenses: Sequence[Lens],
    pairs: Pairs,
    config: Config,
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
        found_again = bool(attempts) and _same(max(attempts, key=_score)[1], partial, config)
        attempts.append((incremental.score(problem, partial, config.score_px), partial))
        if found_again and len(partial.registered) == len(views):
            break
    if not attempts:
        return None
    pause()
    _, best = max(attempts, key=_score)
    finished = finishing.finish(problem, best, images, config.finishing)
    return None if finished is None else as_map(problem, finished, config.incremental.triangulation.max_error_px)


def _score(attempt: tuple[float, PartialMap]) -> float:
    return attempt[0]


def _same(one: PartialMap, other: PartialMap, config: Config) -> bool:
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


def as_map(problem: MappingProblem, finished: finishing.Finished, max_error_px: float) -> Map:
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
        median_angle_deg=float(np.median(angles)),
        rms_px=finished.rms_px,
    )
