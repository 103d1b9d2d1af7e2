"""Incremental mapping for few views: a first pair, one view after the other, bundle adjustment after each.

With a handful of views there is time to try several first pairs and several focal lengths, and to keep the attempt
that explains most of ALL the pairwise matches, those included that it was not built from.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from recon.registration import bundle, placement, tracks
from recon.registration.two_view import TwoView

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Pairs = Mapping[tuple[int, int], TwoView]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    placement: placement.Config = placement.Config()
    max_error_px: float = 2.5  # reprojection error of a kept observation, at 1024 px on the longer side
    robust_px: float = 1.0  # scale of the robust loss while the map grows, at 1024 px on the longer side
    robust_range_px: tuple[float, float] = (0.4, 1.5)  # in the end: three times the median error, within these limits
    min_angle_deg: float = 1.0  # between the rays of a kept point
    min_points: int = 15  # of a map
    growing_tracks: int = 350  # a view, while views are added: more cost time and change no decision
    final_tracks: int = 1500  # a view, in the end
    max_attempts: int = 6  # (focal, first pair) combinations tried
    score_px: float = 1.25  # error at which a match counts no more for an attempt, at 1024 px on the longer side
    same_rotation_deg: float = 0.5  # two attempts whose cameras and
    same_focal: float = 0.02  # focal lengths differ by less have found the same
    doubted_share: float = 0.6  # a view that explains less of its matches is placed anew
    radial_sigma: float = 0.1  # of the radial coefficient where it is free
    shift_sigma: float = 0.01  # of the principal point where it is free, of the longer side
    radial_evidence: float = 20.0  # decrease of the cost, in variances of an observation, that frees it
    shift_evidence: float = 100.0  # the same for the principal point, which hides behind a turn of the cameras
    shift_views: int = 6  # that it takes
    min_decrease: float = 0.01  # as a share of the cost: what is systematic grows with the number of observations


@dataclass(frozen=True, eq=False)
class View:
    """A frame as the mapper sees it."""

    points: Array  # (M, 2) feature pixels relative to the principal point
    lens: int  # cameras with the same number share focal length and distortion
    longer_side: int


@dataclass(frozen=True, eq=False)
class Lens:
    focals: tuple[float, ...]  # candidates in pixels, most likely first
    sigma: float  # of log focal around the candidate; 0 means that it is known
    radial: float = 0.0


@dataclass(frozen=True, eq=False)
class Map:
    """Registered cameras and points. `problem` numbers the cameras as `views` does."""

    views: tuple[int, ...]  # indices of the registered views; the first is the world's origin
    problem: bundle.Problem
    prior: bundle.FocalPrior
    loss: bundle.Config
    agreement: dict[tuple[int, int], float]  # share of each pair's inliers that the map explains
    median_angle_deg: float  # of the points' widest rays
    rms_px: float  # at 1024 px on the longer side


def build_map(views: Sequence[View], lenses: Sequence[Lens], pairs: Pairs, config: Config) -> Map | None:
    """The best map over several starts, or None when no two views can be connected."""
    search = _Search(views, lenses, pairs, config)
    best: tuple[float, _Growth] | None = None
    for pair, focals in _attempts(lenses, pairs, config.max_attempts):
        grown = search.grow(focals, pair)
        if grown is None:
            continue
        score = search.score(grown)
        found_again = best is not None and search.same(best[1], grown)
        if best is None or score > best[0]:
            best = (score, grown)
        if found_again and len(grown.registered) == len(views):
            break
    return search.finish(best[1]) if best else None


def _attempts(lenses: Sequence[Lens], pairs: Pairs, limit: int) -> list[tuple[tuple[int, int], list[float]]]:
    """First pairs with focal lengths (one a lens), the likeliest of both first."""
    first = _first_pairs(pairs)
    num_focals = max(len(lens.focals) for lens in lenses)
    focals = [[lens.focals[min(choice, len(lens.focals) - 1)] for lens in lenses] for choice in range(num_focals)]
    order = sorted(itertools.product(range(len(first)), range(num_focals)), key=lambda place: (sum(place), place[0]))
    return [(first[pair], focals[choice]) for pair, choice in order[:limit]]


def _first_pairs(pairs: Pairs) -> list[tuple[int, int]]:
    """Pairs with many matches that a plane or a rotation does not explain come first."""

    def strength(key: tuple[int, int]) -> float:
        view = pairs[key]
        count = len(view.matches)
        return count * (1.05 - min(1.0, max(view.num_homography, view.num_rotation) / count)) ** 0.5

    return sorted(pairs, key=lambda key: (-strength(key), key))


@dataclass(frozen=True, eq=False)
class _Growth:
    """A map while it grows."""

    registered: tuple[int, ...]
    state: bundle.Problem
    track_of_point: Index  # (P,)
    prior: bundle.FocalPrior


class _Search:
    """What all attempts share."""

    def __init__(self, views: Sequence[View], lenses: Sequence[Lens], pairs: Pairs, config: Config) -> None:
        self._views, self._lenses, self._pairs, self._config = views, lenses, pairs, config
        self._scale = np.array([view.longer_side for view in views]) / 1024.0
        all_tracks = tracks.build([view.points for view in views], pairs)
        self._coarse = tracks.thin(all_tracks, len(views), config.growing_tracks)
        self._fine = tracks.thin(all_tracks, len(views), config.final_tracks)
        robust_px = config.robust_px * float(np.median(self._scale))
        self._quick = bundle.Config(robust_px=robust_px, max_iterations=10, tolerance=1e-3)
        self._thorough = bundle.Config(robust_px=robust_px)

    def grow(self, focals: list[float], first: tuple[int, int]) -> _Growth | None:
        """A map from the pair `first` on, with every view that finds its place."""
        growth = self._begin(focals, first)
        failed: set[int] = set()
        while growth and len(growth.registered) + len(failed) < len(self._views):
            view = self._next_view(growth, failed)
            placed = self._place(growth, view)
            if placed is None:
                failed.add(view)
                continue
            growth = placed
            failed.clear()  # A new view brings new points, from which others may now be found.
        return self._repair(growth) if growth else None

    def score(self, growth: _Growth) -> float:
        """Matches of all pairs that the map explains, the exact ones more."""
        return sum(
            float(np.maximum(0.0, 1.0 - (errors / self._config.score_px) ** 2).sum())
            for errors in self._pair_errors(growth).values()
        )

    def same(self, one: _Growth, other: _Growth) -> bool:
        """Whether both have the same views, turned in the same way."""
        if set(one.registered) != set(other.registered):
            return False
        members = list(one.registered)
        # Each map has a world of its own: the turn from one to the other must be the same for every camera.
        turns = one.state.rotations[members].transpose(0, 2, 1) @ other.state.rotations[members]
        differences = turns[0].T @ turns
        cosine = (np.trace(differences, axis1=1, axis2=2) - 1.0) / 2.0
        turned = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())
        zoomed = float(np.abs(one.state.log_focals - other.state.log_focals).max())
        return turned < self._config.same_rotation_deg and zoomed < self._config.same_focal

    def finish(self, growth: _Growth) -> Map | None:
        """The map of all tracks, adjusted to the end; the radial coefficient freed where that pays."""
        for widen in (3.0, 2.0, 1.0):
            growth = self._adjusted(growth, self._fine, self._thorough, widen)
            if len(growth.state.points) < self._config.min_points:
                return None
            errors = bundle.reprojection_errors(growth.state) / self._scale[growth.state.camera_of]
            robust_px = float(np.clip(3.0 * np.median(errors), *self._config.robust_range_px))
            self._thorough = bundle.Config(robust_px=robust_px * float(np.median(self._scale)))
        lenses = len(self._lenses)
        longer_side = np.array([max(v.longer_side for v in self._views if v.lens == g) for g in range(lenses)])
        config, prior = self._config, growth.prior
        growth = self._freed(
            growth, replace(prior, radial_sigmas=np.full(lenses, config.radial_sigma)), config.radial_evidence
        )
        if len(growth.registered) >= config.shift_views:
            shifted = replace(growth.prior, shift_sigmas=config.shift_sigma * longer_side)
            growth = self._freed(growth, shifted, config.shift_evidence)
        state = growth.state
        centres = -np.einsum("cji,cj->ci", state.rotations, state.translations)
        angles = tracks.largest_angles(centres, state.points, state.camera_of, state.point_of)
        errors = bundle.reprojection_errors(state)
        return Map(
            views=growth.registered,
            problem=state,
            prior=growth.prior,
            loss=self._thorough,
            agreement=self._agreement(growth),
            median_angle_deg=float(np.median(angles)),
            rms_px=float(np.sqrt(np.mean((errors / self._scale[state.camera_of]) ** 2))),
        )

    def _begin(self, focals: list[float], first: tuple[int, int]) -> _Growth | None:
        views, count = self._views, len(self._views)
        rotation, direction, num_inliers = placement.relative_pose(
            self._pairs[first],
            focals[views[first[0]].lens],
            focals[views[first[1]].lens],
            self._config.max_error_px * float(self._scale[first[0]]),
        )
        if num_inliers < self._config.min_points:
            return None
        rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
        rotations[first[1]], translations[first[1]] = rotation, direction
        state = bundle.Problem(
            rotations=rotations,
            translations=translations,
            lens_of_camera=np.array([view.lens for view in views]),
            log_focals=np.log(focals),
            radials=np.array([lens.radial for lens in self._lenses]),
            shifts=np.zeros((len(self._lenses), 2)),
            points=np.zeros((0, 3)),
            camera_of=np.zeros(0, np.int64),
            point_of=np.zeros(0, np.int64),
            pixels=np.zeros((0, 2)),
        )
        prior = bundle.FocalPrior(
            log_focals=np.log(focals),
            sigmas=np.array([lens.sigma for lens in self._lenses]),
            radial_sigmas=np.zeros(len(self._lenses)),
            shift_sigmas=np.zeros(len(self._lenses)),
        )
        # Two views say little about the focal length: it is held close to its candidate until a third view is in.
        tight = replace(prior, sigmas=np.minimum(prior.sigmas, 0.03))
        start = _Growth(first, state, np.zeros(0, np.int64), tight)
        grown = self._adjusted(start, self._coarse, self._quick, widen=4.0)
        return replace(grown, prior=prior) if len(grown.state.points) >= self._config.min_points else None

    def _next_view(self, growth: _Growth, failed: set[int]) -> int:
        """The view that observes most of the map's points."""
        in_map = np.isin(self._coarse.track_of, growth.track_of_point)
        counts = np.bincount(self._coarse.camera_of[in_map], minlength=len(self._views))
        waiting = [view for view in range(len(self._views)) if view not in growth.registered and view not in failed]
        return max(waiting, key=lambda view: (counts[view], -view))

    def _place(self, growth: _Growth, view: int) -> _Growth | None:
        """The map with `view`, or None when it finds no place."""
        placed = placement.place(
            growth.state,
            self._coarse,
            growth.track_of_point,
            view,
            growth.registered,
            self._pairs,
            self._scale,
            self._config.placement,
        )
        if placed is None:
            return None
        state = placement.with_pose(growth.state, view, placed.rotation, placed.translation)
        larger = replace(growth, state=state, registered=(*growth.registered, view))
        return self._adjusted(larger, self._coarse, self._quick, widen=3.0)

    def _repair(self, growth: _Growth) -> _Growth:
        """Views that explain little of their matches are taken out and placed anew, from the whole map."""
        for view in growth.registered[1:]:
            if len(growth.registered) < 4:
                break
            agreement = {key: share for key, share in self._agreement(growth).items() if view in key}
            matched = sum(len(self._pairs[key].matches) for key in agreement)
            explained = sum(share * len(self._pairs[key].matches) for key, share in agreement.items())
            if explained >= self._config.doubted_share * matched:
                continue
            others = tuple(other for other in growth.registered if other != view)
            without = self._adjusted(replace(growth, registered=others), self._coarse, self._quick, widen=2.0)
            again = self._place(without, view)
            if again and self.score(again) > 1.05 * self.score(growth):
                growth = again
        return growth

    def _adjusted(self, growth: _Growth, of_tracks: tracks.Tracks, loss: bundle.Config, widen: float) -> _Growth:
        """Points made anew from the registered views, then everything adjusted."""
        state, track_of_point = _retriangulate(
            growth.state, of_tracks, growth.registered, self._scale, self._config, widen
        )
        if len(state.points) >= self._config.min_points:
            state = bundle.adjust(state, growth.prior, loss, growth.registered[0])
        return replace(growth, state=state, track_of_point=track_of_point)

    def _freed(self, growth: _Growth, prior: bundle.FocalPrior, evidence: float) -> _Growth:
        """The map under a prior with more freedom if the observations ask for it, else as it was.

        Lenses whose focal length is known are calibrated: nothing of them is freed.
        """
        unknown = prior.sigmas > 0
        prior = replace(prior, radial_sigmas=prior.radial_sigmas * unknown, shift_sigmas=prior.shift_sigmas * unknown)
        state = bundle.adjust(growth.state, prior, self._thorough, growth.registered[0])
        before, after = (bundle.robust_cost(problem, self._thorough) for problem in (growth.state, state))
        variance = after / max(1, 2 * len(state.pixels) - 3 * len(state.points))
        if before - after < max(evidence * variance, self._config.min_decrease * before):
            return growth
        return self._adjusted(replace(growth, state=state, prior=prior), self._fine, self._thorough, widen=1.0)

    def _agreement(self, growth: _Growth) -> dict[tuple[int, int], float]:
        return {
            key: float((errors < self._config.max_error_px).mean()) for key, errors in self._pair_errors(growth).items()
        }

    def _pair_errors(self, growth: _Growth) -> dict[tuple[int, int], Array]:
        """Of the matches of all pairs of registered views, pixels at 1024 px on the longer side."""
        return {
            key: placement.pair_errors(growth.state, key, pair) / self._scale[key[0]]
            for key, pair in self._pairs.items()
            if key[0] in growth.registered and key[1] in growth.registered
        }


def _retriangulate(
    state: bundle.Problem,
    all_tracks: tracks.Tracks,
    registered: Sequence[int],
    scale: Array,
    config: Config,
    widen: float,
) -> tuple[bundle.Problem, Index]:
    """All points that the registered cameras agree on, and their tracks.

    An observation stays when its error is at most `widen` times the limit; the worst one of a track that fails is left
    out and the track tried again, twice at most.
    """
    mine = np.isin(all_tracks.camera_of, registered)
    camera, track, pixels = all_tracks.camera_of[mine], all_tracks.track_of[mine], all_tracks.pixels[mine]
    rays = placement.normalise(state, camera, pixels)
    matrices = np.concatenate([state.rotations, state.translations[:, :, None]], 2)
    limit = widen * config.max_error_px * scale
    errors = np.zeros(0)
    points = np.zeros((all_tracks.num_tracks, 3))
    for _ in range(3):
        points = tracks.triangulate(matrices, rays, camera, track, all_tracks.num_tracks)
        errors = bundle.reprojection_errors(
            replace(state, points=np.nan_to_num(points), camera_of=camera, point_of=track, pixels=pixels)
        )
        errors = np.where(np.isnan(points[track, 0]), np.inf, errors) / limit[camera]
        worst = np.zeros(all_tracks.num_tracks)
        np.maximum.at(worst, track, errors)
        keep = (worst[track] <= 1.0) | (errors < worst[track])
        if keep.all():
            break
        camera, track, pixels, rays, errors = camera[keep], track[keep], pixels[keep], rays[keep], errors[keep]
    centres = -np.einsum("cji,cj->ci", state.rotations, state.translations)
    angles = tracks.largest_angles(centres, np.nan_to_num(points), camera, track)
    count = np.bincount(track, minlength=all_tracks.num_tracks)
    worst = np.zeros(all_tracks.num_tracks)
    np.maximum.at(worst, track, errors)
    good = (count >= 2) & (worst <= 1.0) & (angles >= config.min_angle_deg) & ~np.isnan(points[:, 0])
    (kept,) = np.nonzero(good)
    observed = good[track]
    return (
        replace(
            state,
            points=points[kept],
            camera_of=camera[observed],
            point_of=np.searchsorted(kept, track[observed]),
            pixels=pixels[observed],
        ),
        kept,
    )
