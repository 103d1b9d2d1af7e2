"""Incremental mapping for few views: a first pair, one view after the other, bundle adjustment after each.

With a handful of views there is time to try several first pairs and several focal lengths, and to keep the attempt
that explains most of ALL the pairwise matches, those included that it was not built from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
import poselib

from recon.registration import bundle, tracks
from recon.registration.two_view import TwoView

Array = npt.NDArray[np.float64]
Pairs = Mapping[tuple[int, int], TwoView]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_error_px: float = 2.5  # reprojection error of a kept observation, at 1024 px on the longer side
    min_angle_deg: float = 1.0  # between the rays of a kept point
    min_points: int = 15  # 2D-3D inliers that a new view needs
    observations_per_view: int = 700  # more tracks cost time and add nothing to a pose
    max_attempts: int = 6  # (focal, first pair) combinations tried
    good_agreement: float = 0.9  # an attempt with all views and this much agreement ends the search


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
    agreement: dict[tuple[int, int], float]  # share of each pair's inliers that the map explains
    median_angle_deg: float  # of the points' widest rays
    rms_px: float


def build_map(views: Sequence[View], lenses: Sequence[Lens], pairs: Pairs, config: Config) -> Map | None:
    """The best map over several starts, or None when no two views can be connected."""
    all_tracks = tracks.build([view.points for view in views], pairs)
    best: tuple[float, Map] | None = None
    all_tracks = tracks.thin(all_tracks, len(views), config.observations_per_view)
    num_matches = sum(len(pair.matches) for pair in pairs.values())
    num_focals = max(len(lens.focals) for lens in lenses)
    attempts = [
        (pair, [lens.focals[min(choice, len(lens.focals) - 1)] for lens in lenses])
        for choice in range(num_focals)
        for pair in _first_pairs(pairs)[: 3 if choice == 0 else 1]
    ]
    for pair, focals in attempts[: config.max_attempts]:
        grown = _grow(views, lenses, focals, pairs, all_tracks, pair, config)
        if grown is None:
            continue
        score = sum(grown.agreement[key] * len(pairs[key].matches) for key in grown.agreement)
        if best is None or score > best[0]:
            best = (score, grown)
        if len(grown.views) == len(views) and score >= config.good_agreement * num_matches:
            break
    return best[1] if best else None


def _first_pairs(pairs: Pairs) -> list[tuple[int, int]]:
    """Pairs with many matches that a plane or a rotation does not explain come first."""

    def strength(key: tuple[int, int]) -> float:
        view = pairs[key]
        count = len(view.matches)
        return count * (1.05 - min(1.0, max(view.num_homography, view.num_rotation) / count)) ** 0.5

    return sorted(pairs, key=lambda key: (-strength(key), key))


def _grow(
    views: Sequence[View],
    lenses: Sequence[Lens],
    focals: list[float],
    pairs: Pairs,
    all_tracks: tracks.Tracks,
    first: tuple[int, int],
    config: Config,
) -> Map | None:
    start = _relative_pose(views, focals, pairs[first], first, config)
    if start is None:
        return None
    registered = list(first)
    prior = bundle.FocalPrior(
        log_focals=np.log(focals),
        sigmas=np.array([lens.sigma for lens in lenses]),
        radial_sigmas=np.zeros(len(lenses)),
    )
    rotations = np.tile(np.eye(3), (len(views), 1, 1))
    translations = np.zeros((len(views), 3))
    rotations[first[1]], translations[first[1]] = start
    state = bundle.Problem(
        rotations=rotations,
        translations=translations,
        lens_of_camera=np.array([view.lens for view in views]),
        log_focals=np.log(focals),
        radials=np.array([lens.radial for lens in lenses]),
        points=np.zeros((0, 3)),
        camera_of=np.zeros(0, np.int64),
        point_of=np.zeros(0, np.int64),
        pixels=np.zeros((0, 2)),
    )
    scale = np.array([view.longer_side for view in views]) / 1024.0
    # Two views say little about the focal length: it is held close to its candidate until a third view is in.
    tight = replace(prior, sigmas=np.minimum(prior.sigmas, 0.03))
    quick = bundle.Config(max_iterations=12, tolerance=1e-3)
    state, track_of_point = _retriangulate(state, all_tracks, registered, scale, config, widen=4.0)
    state = bundle.adjust(state, tight, quick, first[0])
    failed: set[int] = set()
    while len(registered) + len(failed) < len(views):
        counts = {
            view: int(np.isin(all_tracks.track_of[all_tracks.camera_of == view], track_of_point).sum())
            for view in range(len(views))
            if view not in registered and view not in failed
        }
        view = max(counts, key=lambda key: (counts[key], -key))
        pose = _absolute_pose(state, all_tracks, track_of_point, view, scale[view], config)
        if pose is None:
            failed.add(view)
            continue
        state.rotations[view], state.translations[view] = pose
        registered.append(view)
        failed.clear()  # A new view brings new points, from which others may now be found.
        state, track_of_point = _retriangulate(state, all_tracks, registered, scale, config, widen=3.0)
        state = bundle.adjust(state, prior, quick, first[0])
    for widen in (2.0, 1.0):
        state, track_of_point = _retriangulate(state, all_tracks, registered, scale, config, widen=widen)
        if len(state.points) < config.min_points:
            return None
        state = bundle.adjust(state, prior, bundle.Config(), first[0])
    return _finish(state, prior, pairs, registered, scale, config)


def _relative_pose(
    views: Sequence[View], focals: list[float], pair: TwoView, key: tuple[int, int], config: Config
) -> tuple[Array, Array] | None:
    """Rotation (3, 3) and translation (3,) of the second camera for known focal lengths."""
    view1, view2 = views[key[0]], views[key[1]]
    cameras = [_pinhole(focals[view.lens]) for view in (view1, view2)]
    pose, info = poselib.estimate_relative_pose(
        view1.points[pair.matches[:, 0]],
        view2.points[pair.matches[:, 1]],
        cameras[0],
        cameras[1],
        {"max_epipolar_error": config.max_error_px * view1.longer_side / 1024, "seed": 0, "min_iterations": 100},
    )
    if sum(info["inliers"]) < config.min_points:
        return None
    return np.asarray(pose.R), np.asarray(pose.t)


def _pinhole(focal: float) -> dict[str, object]:
    """PoseLib's camera for pixels relative to the principal point."""
    return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal, 0, 0]}


def _absolute_pose(
    state: bundle.Problem,
    all_tracks: tracks.Tracks,
    track_of_point: npt.NDArray[np.int64],
    view: int,
    scale: float,
    config: Config,
) -> tuple[Array, Array] | None:
    """The pose of `view` from the points that it sees, or None when too few agree."""
    mine = all_tracks.camera_of == view
    if len(track_of_point) == 0 or not mine.any():
        return None
    position = np.searchsorted(track_of_point, all_tracks.track_of[mine])
    position = np.minimum(position, len(track_of_point) - 1)
    known = track_of_point[position] == all_tracks.track_of[mine]
    if known.sum() < config.min_points:
        return None
    focal = float(np.exp(state.log_focals[state.lens_of_camera[view]]))
    pose, info = poselib.estimate_absolute_pose(
        all_tracks.pixels[mine][known],
        state.points[position[known]],
        _pinhole(focal),
        {"max_reproj_error": 3.0 * config.max_error_px * scale, "seed": 0, "min_iterations": 200},
    )
    num_inliers = sum(info["inliers"])
    if num_inliers < max(config.min_points, 0.2 * known.sum()):
        return None
    return np.asarray(pose.R), np.asarray(pose.t)


def _retriangulate(
    state: bundle.Problem,
    all_tracks: tracks.Tracks,
    registered: list[int],
    scale: Array,
    config: Config,
    widen: float,
) -> tuple[bundle.Problem, npt.NDArray[np.int64]]:
    """All points that the registered cameras agree on, and their tracks.

    An observation stays when its error is at most `widen` times the limit; the worst one of a track that fails is left
    out and the track tried again, twice at most.
    """
    mine = np.isin(all_tracks.camera_of, registered)
    camera, track, pixels = all_tracks.camera_of[mine], all_tracks.track_of[mine], all_tracks.pixels[mine]
    lens = state.lens_of_camera[camera]
    rays = undistort(pixels / np.exp(state.log_focals[lens])[:, None], state.radials[lens])
    matrices = np.concatenate([state.rotations, state.translations[:, :, None]], 2)
    limit = widen * config.max_error_px * scale
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
        camera, track, pixels, rays = camera[keep], track[keep], pixels[keep], rays[keep]
    centres = -np.einsum("cji,cj->ci", state.rotations, state.translations)
    angles = tracks.largest_angles(centres, np.nan_to_num(points), camera, track)
    count = np.bincount(track, minlength=all_tracks.num_tracks)
    worst = np.zeros(all_tracks.num_tracks)
    np.maximum.at(worst, track, errors[keep] if len(errors) != len(track) else errors)
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


def undistort(distorted: Array, radials: Array) -> Array:
    """Normalised coordinates (M, 2) without their radial distortion, by fixed-point iteration."""
    result = distorted
    for _ in range(5):
        result = distorted / (1.0 + radials * (result**2).sum(1))[:, None]
    return result


def _finish(
    state: bundle.Problem,
    prior: bundle.FocalPrior,
    pairs: Pairs,
    registered: list[int],
    scale: Array,
    config: Config,
) -> Map:
    centres = -np.einsum("cji,cj->ci", state.rotations, state.translations)
    angles = tracks.largest_angles(centres, state.points, state.camera_of, state.point_of)
    errors = bundle.reprojection_errors(state)
    return Map(
        views=tuple(registered),
        problem=state,
        prior=prior,
        agreement={
            key: pair_agreement(state, key, pair, config.max_error_px * scale[key[0]])
            for key, pair in pairs.items()
            if key[0] in registered and key[1] in registered
        },
        median_angle_deg=float(np.median(angles)) if len(angles) else 0.0,
        rms_px=float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0,
    )


def pair_agreement(state: bundle.Problem, key: tuple[int, int], pair: TwoView, limit: float) -> float:
    """Share of a pair's matches whose Sampson error under the estimated cameras is within `limit` pixels."""
    rays = []
    for view, points in zip(key, (pair.points1, pair.points2), strict=True):
        lens = state.lens_of_camera[view]
        normalised = undistort(points / np.exp(state.log_focals[lens]), np.full(len(points), state.radials[lens]))
        rays.append(np.column_stack([normalised, np.ones(len(points))]))
    rotation = state.rotations[key[1]] @ state.rotations[key[0]].T
    translation = state.translations[key[1]] - rotation @ state.translations[key[0]]
    essential = bundle.cross_matrix(translation[None])[0] @ rotation
    line2, line1 = rays[0] @ essential.T, rays[1] @ essential
    residual = np.abs((rays[1] * line2).sum(1))
    focal1, focal2 = np.exp(state.log_focals[state.lens_of_camera[list(key)]])
    gradient = (line2[:, :2] ** 2).sum(1) / focal2**2 + (line1[:, :2] ** 2).sum(1) / focal1**2
    return float((residual / np.sqrt(np.maximum(gradient, 1e-30)) < limit).mean())
