"""The mapping problem (views, lenses, verified pairs, tracks), and the sparse model: a solution under way.

A view enters it by resection.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from splatnode.recon import poselib
from splatnode.recon.geometry import cross
from splatnode.recon.keyframes import REFERENCE_SIDE
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment, multiview_geometry
from splatnode.recon.registration.multiview_geometry import Tracks

# The mapping problem (views, lenses, verified pairs, tracks), and the sparse model: a solution under way.

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Pair = tuple[int, int]
Pairs = Mapping[Pair, TwoView]


@dataclass(frozen=True, eq=False)
class MapperView:
    """A frame as the mapper sees it."""

    points: Array  # (M, 2) feature pixels relative to the principal point
    lens: int  # views with the same number share focal length, distortion and principal point
    longer_side: int  # pixels


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens as it is known before its views are mapped."""

    focals: tuple[float, ...]  # candidates in pixels, the most likely first
    sigma: float  # of log focal around the candidate; 0: it is calibrated
    radial: tuple[float, float] = (0.0, 0.0)  # radial coefficients
    # Pixels, tried beside the candidates where these lead to one far from it; None where a focal length was told
    typical: float | None = None
    # Pixels: sigma of the principal point where the search for it begins, of what may be a crop; 0: there is no search
    widest_shift: float = 0.0


@dataclass(frozen=True, eq=False)
class MapperInput:
    """The input that all attempts at a model share: C views, G lenses, verified pairs and tracks."""

    views: tuple[MapperView, ...]
    lenses: tuple[Lens, ...]
    pairs: Pairs  # by the positions of their views (i < j)
    scale: Array  # (C,) longer side of each view over REFERENCE_SIDE, at which thresholds in pixels hold
    growing_tracks: multiview_geometry.Tracks  # some, for the time while views are added
    final_tracks: multiview_geometry.Tracks  # more, for the last adjustment


@dataclass(frozen=True, eq=False)
class SparseModel:
    """A model under way. Its estimate has all C views of the problem as cameras; only the registered ones are valid."""

    registered: tuple[int, ...]  # views; the first one is the camera that adjustments fix
    estimate: bundle_adjustment.Problem
    prior: bundle_adjustment.LensPrior
    track_of_point: Index  # (P,) ascending


def prepare(
    views: Sequence[MapperView], lenses: Sequence[Lens], pairs: Pairs, max_growing_tracks: int, max_final_tracks: int
) -> MapperInput:
    """The mapping problem of `views`, with about so many tracks a view while views are added, and in the end."""
    every = multiview_geometry.build([view.points for view in views], pairs)
    return MapperInput(
        views=tuple(views),
        lenses=tuple(lenses),
        pairs=pairs,
        scale=np.array([view.longer_side for view in views]) / REFERENCE_SIDE,
        growing_tracks=multiview_geometry.thin(every, max_growing_tracks),
        final_tracks=multiview_geometry.thin(every, max_final_tracks),
    )


def difference(one: SparseModel, other: SparseModel) -> tuple[float, float]:
    """The largest rotation between the views that both models have, degrees, and the largest change of a log focal.

    Each model has a world frame of its own: the rotation from one frame to the other, as the first common view gives
    it, is taken out.
    """
    common = sorted(set(one.registered) & set(other.registered))
    if not common:
        return 0.0, 0.0
    rotations = one.estimate.rotations[common].transpose(0, 2, 1) @ other.estimate.rotations[common]
    cosine = (np.trace(rotations[0].T @ rotations, axis1=1, axis2=2) - 1.0) / 2.0
    rotation_deg = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())
    return rotation_deg, float(np.abs(one.estimate.log_focals - other.estimate.log_focals).max())


# Resection (PnP): the pose of a view from a model's points and from its pairs with registered views.
#
# Where structures repeat, the pose with most correspondences is not always the right one. Every neighbour proposes a
# pose of its own, and the one with most inliers among ALL the evidence, points and pairs, is taken.

Flags = npt.NDArray[np.bool_]

# While a model grows, its points and poses are not exact yet: errors may be this many times `max_error_px` large.
_POINT_TOLERANCE = 3.0  # of reprojection errors
_PAIR_TOLERANCE = 2.0  # of Sampson errors to registered views
_SCALE_TOLERANCE = 4.0  # of points that fix the length of a translation, whose direction is not exact either
_MAX_NEIGHBOURS = 4  # registered views, those with most matches, that propose a pose
_ITERATIONS = {"min_iterations": 200, "max_iterations": 5000, "seed": 0}  # of RANSAC: 5000 do for 10 % inliers
# Focal lengths that are tried for a view that its lens does not fit, over that of the lens
_FOCAL_FACTORS = (1.0, 0.4, 0.5, 0.63, 0.72, 0.8, 0.87, 0.93, 1.07, 1.15, 1.25, 1.38, 1.55, 1.75, 2.0, 2.5, 3.2)
_FITTING = 0.9  # share of the points that fit, below which displaced principal points are tried, and which they need
_SHIFTS = (0.07, 0.14)  # by which principal points are displaced then, shares of the longer side
_DIRECTIONS = ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (0.7, 0.7), (0.7, -0.7), (-0.7, 0.7), (-0.7, -0.7))
_NEAR_FACTORS = (1.0, 0.9, 1.1)  # focal lengths that are tried with them, over the best without
_OWN_FOCAL_TOLERANCE = 1.5  # of reprojection errors then: the model is finished
_MORE_POINTS = 1.1  # times as many points must fit with another focal length
_MIN_SCALE_RATIO = 0.4  # share of the points that may fix the length of a translation which must agree on it


class ResectionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Resection (PnP): the pose of a view from a model's points and from its pairs with registered views."""

    max_error_px: float = 2.5  # largest error of an exact match, pixels at REFERENCE_SIDE
    min_points: int = 15  # 2D-3D inliers that a proposed pose needs
    min_inlier_ratio: float = 0.2  # share of the 2D-3D correspondences that must be inliers
    ample_points: int = 40  # 2D-3D inliers from which on relative poses are not needed as proposals
    min_scale_points: int = 5  # points that must agree on the length of the translation of a relative pose


@dataclass(frozen=True, eq=False)
class Resection:
    """The pose of a view, world to camera, with its inliers among the model's points and all matches."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    num_inliers: int
    inlier_ratio: float


@dataclass(frozen=True, eq=False)
class Correspondences:
    """2D-3D correspondences: the model's points that a view observes."""

    pixels: Array  # (M, 2) relative to the principal point, without distortion
    points: Array  # (M, 3) world
    tracks: Index  # (M,)


def resect(problem: MapperInput, partial: SparseModel, view: int, config: ResectionConfig) -> Resection | None:
    """The proposed pose of `view` with most inliers, or None when no proposal has enough."""
    correspondences = _correspondences(partial, problem.growing_tracks, view)
    neighbours = {
        other: problem.pairs[_pair(view, other)] for other in partial.registered if _pair(view, other) in problem.pairs
    }
    limit = config.max_error_px * problem.scale[view]
    focal = float(np.exp(partial.estimate.log_focals[partial.estimate.lens_of_camera[view]]))
    available = max(1, len(correspondences.tracks) + sum(len(pair.matches) for pair in neighbours.values()))
    best: Resection | None = None
    for rotation, translation in _proposals(problem, partial, correspondences, view, neighbours, config):
        errors = reprojection_errors(correspondences, rotation, translation, focal)
        num_inliers = int((errors < _POINT_TOLERANCE * limit).sum())
        proposed = bundle_adjustment.replace_pose(partial.estimate, view, rotation, translation)
        for other, pair in neighbours.items():
            errors = multiview_geometry.sampson_errors(proposed, _pair(view, other), pair)
            num_inliers += int((errors < _PAIR_TOLERANCE * limit).sum())
        if best is None or num_inliers > best.num_inliers:
            best = Resection(rotation, translation, num_inliers, num_inliers / available)
    return best


@dataclass(frozen=True, eq=False)
class OwnLens:
    """The lens of a view that does not have that of the others."""

    focal: float  # pixels
    shift: Array  # (2,) of the principal point, pixels


def find_own_lens(problem: MapperInput, partial: SparseModel, view: int, config: ResectionConfig) -> OwnLens | None:
    """The lens with which most of the model's points fit a pose of `view`, where it is not the common one.

    None where the common lens, which is tried first, fits nearly as many. Displaced principal points, as of crops and
    keystone corrections, are tried where other focal lengths alone leave many points that do not fit; one counts with
    which nearly all fit, for of so many hypotheses about few points some fit by chance.
    """
    correspondences = _correspondences(partial, problem.growing_tracks, view)
    limit = config.max_error_px * problem.scale[view]
    common = float(np.exp(partial.estimate.log_focals[partial.estimate.lens_of_camera[view]]))
    everything = np.ones(len(correspondences.tracks), bool)

    def count(lens: OwnLens) -> int:
        moved = replace(correspondences, pixels=correspondences.pixels - lens.shift)
        found = _pnp(moved, everything, lens.focal, limit, config, _OWN_FOCAL_TOLERANCE)
        return 0 if found is None else found[2]

    middle = np.zeros(2)
    zoomed = {factor: count(OwnLens(factor * common, middle)) for factor in _FOCAL_FACTORS}
    factor = max(zoomed, key=lambda each: zoomed[each])
    best, most = OwnLens(factor * common, middle), zoomed[factor]
    if most < _FITTING * len(everything):
        side, focal = problem.views[view].longer_side, best.focal
        for size, direction, factor in itertools.product(_SHIFTS, _DIRECTIONS, _NEAR_FACTORS):
            other = OwnLens(factor * focal, size * side * np.array(direction))
            fitting = count(other)
            if fitting > max(most, _FITTING * len(everything)):
                best, most = other, fitting
    return best if most > _MORE_POINTS * zoomed[1.0] else None


def reprojection_errors(correspondences: Correspondences, rotation: Array, translation: Array, focal: float) -> Array:
    """(M,) pixels, without distortion; infinite behind the camera. The pose is world to camera."""
    in_camera = correspondences.points @ rotation.T + translation
    depth = np.maximum(in_camera[:, 2:], 1e-9)
    error = np.linalg.norm(in_camera[:, :2] / depth * focal - correspondences.pixels, axis=1)
    return np.where(in_camera[:, 2] > 0, error, np.inf)


def _pair(view: int, other: int) -> Pair:
    return min(view, other), max(view, other)


def _correspondences(partial: SparseModel, tracks: Tracks, view: int) -> Correspondences:
    own = tracks.camera_of == view
    track_of, pixels = tracks.track_of[own], tracks.pixels[own]
    if len(partial.track_of_point) == 0:
        return Correspondences(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, np.int64))
    position = np.minimum(np.searchsorted(partial.track_of_point, track_of), len(partial.track_of_point) - 1)
    found = partial.track_of_point[position] == track_of
    straight = _straight(partial.estimate, view, pixels[found])
    return Correspondences(straight, partial.estimate.points[position[found]], track_of[found])


def _straight(estimate: bundle_adjustment.Problem, view: int, pixels: Array) -> Array:
    """(M, 2) pixels as a pinhole would show them: a lens that is known to bend lines is taken out."""
    lens = estimate.lens_of_camera[view]
    if not (estimate.radials[lens].any() or estimate.shifts[lens].any()):
        return pixels
    return bundle_adjustment.normalise(estimate, np.full(len(pixels), view), pixels) * np.exp(estimate.log_focals[lens])


def _proposals(
    problem: MapperInput,
    partial: SparseModel,
    correspondences: Correspondences,
    view: int,
    neighbours: Mapping[int, TwoView],
    config: ResectionConfig,
) -> Iterator[tuple[Array, Array]]:
    """Poses by PnP from all correspondences, then from those that one neighbour observes too.

    Where these have few inliers, also poses relative to a neighbour, with the length that the common points give.
    """
    limit = config.max_error_px * problem.scale[view]
    focals = np.exp(partial.estimate.log_focals[partial.estimate.lens_of_camera])
    strongest = sorted(neighbours, key=lambda other: -len(neighbours[other].matches))[:_MAX_NEIGHBOURS]
    tracks = problem.growing_tracks
    shared = [np.isin(correspondences.tracks, tracks.track_of[tracks.camera_of == other]) for other in strongest]
    most = 0
    for chosen in (np.ones(len(correspondences.tracks), bool), *shared):
        found = _pnp(correspondences, chosen, float(focals[view]), limit, config)
        if found is not None:
            rotation, translation, num_inliers = found
            most = max(most, num_inliers)
            yield rotation, translation
    if most >= config.ample_points:
        return
    for other, chosen in zip(strongest, shared, strict=True):
        if chosen.sum() >= config.min_scale_points:
            points, rays = correspondences.points[chosen], correspondences.pixels[chosen] / focals[view]
            beside = _estimate_by_neighbour(partial, view, other, neighbours[other], points, rays, limit, config)
            if beside is not None:
                yield beside


def _pnp(
    correspondences: Correspondences,
    chosen: Flags,
    focal: float,
    limit: float,
    config: ResectionConfig,
    tolerance: float = _POINT_TOLERANCE,
) -> tuple[Array, Array, int] | None:
    """Rotation, translation and number of inliers from the `chosen` correspondences; None for too few inliers."""
    if chosen.sum() < config.min_points:
        return None
    pose, info = poselib.estimate_absolute_pose(
        correspondences.pixels[chosen],
        correspondences.points[chosen],
        multiview_geometry.pinhole(focal),
        {"max_reproj_error": tolerance * limit, **_ITERATIONS},
    )
    num_inliers = int(sum(info["inliers"]))
    if num_inliers < max(config.min_points, config.min_inlier_ratio * chosen.sum()):
        return None
    return np.asarray(pose.R), np.asarray(pose.t), num_inliers


def _estimate_by_neighbour(
    partial: SparseModel,
    view: int,
    other: int,
    pair: TwoView,
    points: Array,  # (M, 3) that both observe
    rays: Array,  # (M, 2) where `view` observes them, at depth 1
    limit: float,
    config: ResectionConfig,
) -> tuple[Array, Array] | None:
    """The pose of `view` by its relative pose to the view `other`; None for too few inliers of either part."""
    estimate = partial.estimate
    focals = np.exp(estimate.log_focals[estimate.lens_of_camera])
    first, second = _pair(view, other)
    straight = (_straight(estimate, each, points) for each, points in ((first, pair.points1), (second, pair.points2)))
    points1, points2 = straight
    rotation, direction, num_inliers = multiview_geometry.relative_pose(
        replace(pair, points1=points1, points2=points2), float(focals[first]), float(focals[second]), limit
    )
    if num_inliers < 2 * config.min_points:  # matches fix a relative pose less well than points do a pose
        return None
    if view == first:  # The relative pose leads from the view to its neighbour: it is inverted.
        rotation, direction = rotation.T, -rotation.T @ direction
    in_other = points @ estimate.rotations[other].T + estimate.translations[other]
    length = _length(in_other @ rotation.T, direction, rays, limit / focals[view], config.min_scale_points)
    if length is None:
        return None
    return rotation @ estimate.rotations[other], rotation @ estimate.translations[other] + length * direction


def _length(turned: Array, direction: Array, rays: Array, limit: float, min_points: int) -> float | None:
    """The s for which most points `turned + s * direction` (M, 3) project to `rays` (M, 2); None where few agree.

    Points that project to their ray for no s are wrong matches and count neither for nor against.
    """
    rays3 = np.column_stack([rays, np.ones(len(rays))])
    across = cross(rays3, direction)
    lengths = -(cross(rays3, turned) * across).sum(1) / np.maximum((across**2).sum(1), 1e-12)

    def agree(moved: Array) -> Flags:
        depth = moved[..., 2:]
        error = np.linalg.norm(moved[..., :2] / np.maximum(depth, 1e-9) - rays, axis=-1)
        return (error < _SCALE_TOLERANCE * limit) & (depth[..., 0] > 0)

    possible = lengths[(lengths > 0) & agree(turned + lengths[:, None] * direction)]
    if len(possible) == 0:
        return None
    counts = agree(turned[None] + possible[:, None, None] * direction).sum(1)
    best = int(counts.argmax())
    return float(possible[best]) if counts[best] >= max(min_points, _MIN_SCALE_RATIO * len(possible)) else None


# Repeated structures: windows of a facade match other windows beside them, and an epipolar geometry explains both. What
# such a match shows has another depth than what other pairs show around it. Where a place has many of them, the tracks
# of the last adjustment are made without them; what is judged by matches counts them all.

_NEIGHBOURS = 24  # matches around a match in its image, of all pairs, whose depths are compared with its own
_MIN_OTHERS = 6  # of them that are of other pairs
_SAME_FEATURE_PX = 0.5  # largest distance of matches of the same feature
_MAX_AGREEING = 0.2  # share of those that may have its depth where it is another
# Difference of inverse depths up to which they are the same: relative, and in standard deviations. A match with the
# window beside has half or twice the depth; a lens that is not known yet changes depths by less
_SAME_DEPTH, _SAME_SIGMAS = 0.4, 3.0
_MIN_COMPARED = 40  # matches of a pair that loses some
# Share of a pair's matches at other depths from which on they are left out; of more, poses or lenses are wrong
_MIN_REPEATED, _MAX_REPEATED = 0.1, 0.5
_MIN_OF_ALL = 0.05  # share of all matches at other depths, below which a place does not repeat itself
_MATCH_PX = 1.5  # standard deviation of a match, at REFERENCE_SIDE
_EXACT_DEPTH = 0.1  # largest standard deviation of a neighbour's inverse depth, over the median of the view


def drop_repeated_structures(
    problem: MapperInput, partial: SparseModel, max_growing_tracks: int, max_final_tracks: int
) -> MapperInput:
    """The problem with tracks without the matches of repeated structures; itself where a place has few of them."""
    pairs, found = dict(problem.pairs), find_other_depths(problem, partial)
    if sum(int(other.sum()) for other in found.values()) < _MIN_OF_ALL * sum(map(len, found.values())):
        return problem
    for key, other in found.items():
        if len(other) >= _MIN_COMPARED and _MIN_REPEATED <= other.mean() <= _MAX_REPEATED:
            pairs[key] = pairs[key].select(~other)
    if all(pairs[key] is pair for key, pair in problem.pairs.items()):
        return problem
    less = prepare(problem.views, problem.lenses, pairs, max_growing_tracks, max_final_tracks)
    return replace(problem, growing_tracks=less.growing_tracks, final_tracks=less.final_tracks)


def find_other_depths(problem: MapperInput, partial: SparseModel) -> dict[Pair, Flags]:
    """(M,) for each pair of registered views, its matches whose depth in a view is not that of the matches around."""
    estimate, registered = partial.estimate, set(partial.registered)
    pairs = {key: pair for key, pair in problem.pairs.items() if registered.issuperset(key)}
    inverse = {key: _inverse_depths(estimate, key, pair) for key, pair in pairs.items()}
    found = {key: np.zeros(len(pair.matches), bool) for key, pair in pairs.items()}
    centres = bundle_adjustment.centres(estimate)
    for view in partial.registered:
        sides = [(key, key.index(view)) for key in pairs if view in key]
        if not sides:
            continue
        sigma_rad = _MATCH_PX * problem.scale[view] / np.exp(estimate.log_focals[estimate.lens_of_camera[view]])
        apart = [np.linalg.norm(centres[key[0]] - centres[key[1]]) for key, _ in sides]
        counts = [len(pairs[key].matches) for key, _ in sides]
        other = _differ_from_neighbours(
            np.concatenate([(pairs[key].points1, pairs[key].points2)[side] for key, side in sides]),
            np.concatenate([inverse[key][side] for key, side in sides]),
            np.repeat(sigma_rad / np.maximum(apart, 1e-12), counts),
            np.repeat(np.arange(len(sides)), counts),
        )
        for (key, _), part in zip(sides, np.split(other, np.cumsum(counts)[:-1]), strict=True):
            found[key] |= part
    return found


def _inverse_depths(estimate: bundle_adjustment.Problem, views: Pair, pair: TwoView) -> Array:
    """(2, M) the inverse depths of the matches in both views; NaN for what lies behind a camera, or nowhere."""
    count = len(pair.matches)
    camera_of, match_of = np.repeat(views, count), np.tile(np.arange(count), 2)
    rays = bundle_adjustment.normalise(estimate, camera_of, np.concatenate([pair.points1, pair.points2]))
    matrices = np.concatenate([estimate.rotations, estimate.translations[:, :, None]], 2)
    points = multiview_geometry.triangulate(matrices, rays, camera_of, match_of, count)
    depths = estimate.rotations[list(views), 2] @ points.T + estimate.translations[list(views), 2, None]
    return 1.0 / np.where(depths > 0, depths, np.nan)


def _differ_from_neighbours(pixels: Array, inverse: Array, sigmas: Array, pair_of: Index) -> Flags:
    """(M,) whether hardly any match of other pairs around a pixel (M, 2), and none of it, has its inverse depth (M,).

    Where a near thing stands before a far one, the same feature has the same depth in other pairs.
    """
    known = np.isfinite(inverse)
    exact = known & (sigmas < _EXACT_DEPTH * np.median(inverse[known])) if known.any() else known
    if exact.sum() < _NEIGHBOURS:
        return np.zeros(len(inverse), bool)
    distances, near = KDTree(pixels[exact]).query(pixels, _NEIGHBOURS)
    around = inverse[exact][near]
    others = pair_of[exact][near] != pair_of[:, None]
    most = np.maximum(_SAME_DEPTH * around, _SAME_SIGMAS * np.hypot(sigmas[:, None], sigmas[exact][near]))
    agree = (np.abs(inverse[:, None] - around) <= most) & others
    counts, same_feature = others.sum(1), distances < _SAME_FEATURE_PX
    is_alone = (counts >= _MIN_OTHERS) & (agree.sum(1) <= _MAX_AGREEING * counts)
    return is_alone & ~(agree & same_feature).any(1)


# Inlier ratios: the share of a pair's matches that agree with the poses of a model, used or not in making it.


def pair_errors(problem: MapperInput, partial: SparseModel) -> dict[Pair, Array]:
    """Sampson errors of the matches of all pairs of registered views, pixels at REFERENCE_SIDE."""
    return {
        (i, j): multiview_geometry.sampson_errors(partial.estimate, (i, j), pair) / problem.scale[i]
        for (i, j), pair in problem.pairs.items()
        if i in partial.registered and j in partial.registered
    }


def compute_median_error(problem: MapperInput, partial: SparseModel) -> float:
    """Returns the median Sampson error of all matches, pixels at REFERENCE_SIDE; missing views count as infinite."""
    errors = pair_errors(problem, partial)
    return float(
        np.median(np.concatenate([errors.get(k, np.full(len(p.matches), np.inf)) for k, p in problem.pairs.items()]))
    )


def inlier_ratios(problem: MapperInput, partial: SparseModel, max_error_px: float) -> dict[Pair, float]:
    """The share of each pair's matches with Sampson errors below `max_error_px`, pixels at REFERENCE_SIDE."""
    return {pair: float((errors < max_error_px).mean()) for pair, errors in pair_errors(problem, partial).items()}


def compute_pooled_ratio(ratios: Mapping[Pair, float], pairs: Pairs, view: int | None = None) -> float:
    """The share of inliers among all matches of the pairs with `ratios`, or of those with `view`; 0 without any."""
    chosen = {pair: ratio for pair, ratio in ratios.items() if view is None or view in pair}
    num_matches = sum(len(pairs[pair].matches) for pair in chosen)
    return sum(ratio * len(pairs[pair].matches) for pair, ratio in chosen.items()) / max(1, num_matches)
