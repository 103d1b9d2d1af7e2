"""A map that grows: a first pair, one view after the other, bundle adjustment after each."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle, mapping_problem, resection, tracks, triangulation
from splatnode.recon.registration.mapping_problem import Growth, Survey

Array = npt.NDArray[np.float64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    resection: resection.Config = resection.Config()
    triangulation: triangulation.Config = triangulation.Config()
    robust_px: float = 1.0  # scale of the robust loss, at 1024 px on the longer side
    min_points: int = 15  # of a map
    candidates: int = 3  # views that are tried as the next one
    doubted_share: float = 0.6  # a view that explains less of its matches is placed anew
    pair_focal_sigma: float = 0.03  # of log focal while there are two views, which say little about it


def grow(of: Survey, focals: list[float], first: tuple[int, int], config: Config) -> Growth | None:
    """A map from the pair `first` on, with every view that finds its place. `focals` (one a lens) are in pixels."""
    growth = _begin(of, focals, first, config)
    return _repair(of, extend(of, growth, config), config) if growth else None


def score(of: Survey, growth: Growth, zero_px: float) -> float:
    """Matches of all pairs that the map explains, the exact ones more; those with errors above `zero_px` not at all."""
    errors = mapping_problem.pair_errors(of, growth).values()
    return sum(float(np.maximum(0.0, 1.0 - (of_pair / zero_px) ** 2).sum()) for of_pair in errors)


def adjusted(
    of: Survey,
    growth: Growth,
    of_tracks: tracks.Tracks,
    loss: bundle.Config,
    widen: float,
    config: triangulation.Config,
) -> Growth:
    """Points made anew from the registered views (limits times `widen`), then everything adjusted."""
    problem, track_of_point = triangulation.retriangulate(
        growth.problem, of_tracks, growth.registered, of.scale, config, widen
    )
    if len(problem.points):
        problem = bundle.adjust(problem, growth.prior, loss, growth.registered[0])
    return replace(growth, problem=problem, track_of_point=track_of_point)


def quickly_adjusted(of: Survey, growth: Growth, widen: float, config: Config) -> Growth:
    """`adjusted` with few tracks and few iterations, as it is done after each view."""
    robust_px = config.robust_px * float(np.median(of.scale))
    loss = bundle.Config(robust_px=robust_px, max_iterations=10, tolerance=1e-3)
    return adjusted(of, growth, of.coarse, loss, widen, config.triangulation)


def _begin(of: Survey, focals: list[float], first: tuple[int, int], config: Config) -> Growth | None:
    count, num_lenses = len(of.views), len(of.lenses)
    rotation, direction, num_inliers = resection.relative_pose(
        of.pairs[first],
        focals[of.views[first[0]].lens],
        focals[of.views[first[1]].lens],
        config.triangulation.max_error_px * float(of.scale[first[0]]),
    )
    if num_inliers < config.min_points:
        return None
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    rotations[first[1]], translations[first[1]] = rotation, direction
    problem = bundle.Problem(
        rotations=rotations,
        translations=translations,
        lens_of_camera=np.array([view.lens for view in of.views]),
        log_focals=np.log(focals),
        radials=np.array([lens.radial for lens in of.lenses]),
        shifts=np.zeros((num_lenses, 2)),
        points=np.zeros((0, 3)),
        camera_of=np.zeros(0, np.int64),
        point_of=np.zeros(0, np.int64),
        pixels=np.zeros((0, 2)),
    )
    prior = bundle.LensPrior(
        log_focals=np.log(focals),
        sigmas=np.array([lens.sigma for lens in of.lenses]),
        radial_sigmas=np.zeros(num_lenses),
        shift_sigmas=np.zeros(num_lenses),
    )
    tight = replace(prior, sigmas=np.minimum(prior.sigmas, config.pair_focal_sigma))
    start = Growth(first, problem, tight, np.zeros(0, np.int64))
    grown = quickly_adjusted(of, start, 4.0, config)
    return replace(grown, prior=prior) if len(grown.problem.points) >= config.min_points else None


def extend(of: Survey, growth: Growth, config: Config) -> Growth:
    """The map with every further view that finds its place.

    Of the views that observe most of the map, the one comes next whose matches agree best on where it stands: one that
    repeated structures put in a wrong place contradicts some of its neighbours, and waits until more of them are there.
    """
    failed: set[int] = set()
    while len(growth.registered) + len(failed) < len(of.views):
        tried = _waiting(of, growth, failed)[: config.candidates]
        placed = {view: _place(of, growth, view, config) for view in tried}
        failed |= {view for view, placement_ in placed.items() if placement_ is None}
        found = {view: placement_ for view, placement_ in placed.items() if placement_ is not None}
        if not found:
            continue
        best = max(found, key=lambda view: (found[view].share, -view))
        problem = resection.with_pose(growth.problem, best, found[best].rotation, found[best].translation)
        larger = replace(growth, problem=problem, registered=(*growth.registered, best))
        growth = quickly_adjusted(of, larger, 3.0, config)
        failed.clear()  # A new view brings new points, from which others may now be found.
    return growth


def _waiting(of: Survey, growth: Growth, failed: set[int]) -> list[int]:
    """Views that may come next; those that observe most of the map's points first."""
    in_map = np.isin(of.coarse.track_of, growth.track_of_point)
    counts = np.bincount(of.coarse.camera_of[in_map], minlength=len(of.views))
    waiting = [view for view in range(len(of.views)) if view not in growth.registered and view not in failed]
    return sorted(waiting, key=lambda view: (-counts[view], view))


def _place(of: Survey, growth: Growth, view: int, config: Config) -> resection.Placement | None:
    """Where `view` stands, or None when it finds no place."""
    return resection.place(
        growth.problem,
        of.coarse,
        growth.track_of_point,
        view,
        growth.registered,
        of.pairs,
        of.scale,
        config.resection,
    )


def _repair(of: Survey, growth: Growth, config: Config) -> Growth:
    """Views that explain little of their matches are taken out and placed anew, as long as that explains more.

    First all of them at once, because views that are wrong together hold each other; then one after the other.
    """
    doubted = _doubted(of, growth, config)
    for group in [doubted, *([view] for view in doubted)]:
        rest = tuple(view for view in growth.registered if view not in group)
        if not group or len(rest) < 3:
            continue
        without = quickly_adjusted(of, replace(growth, registered=rest), 2.0, config)
        if len(without.problem.points) < config.min_points:
            continue
        again = extend(of, without, config)
        limit = config.triangulation.max_error_px
        if score(of, again, limit) > 1.05 * score(of, growth, limit):
            growth = again
    return growth


def _doubted(of: Survey, growth: Growth, config: Config) -> list[int]:
    """Views that explain less than a share of their matches, the worst first."""
    agreement = mapping_problem.agreement(of, growth, config.triangulation.max_error_px)
    shares = {}
    for view in growth.registered:
        mine = {key: share for key, share in agreement.items() if view in key}
        matched = sum(len(of.pairs[key].matches) for key in mine)
        shares[view] = sum(share * len(of.pairs[key].matches) for key, share in mine.items()) / max(1, matched)
    return sorted((view for view in shares if shares[view] < config.doubted_share), key=lambda view: shares[view])
