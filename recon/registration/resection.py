"""Where a new view stands, given a map: several proposals, and how much of all the evidence each one explains.

Repeated structures make the most popular pose not always the right one. Each neighbour proposes a pose of its own, and
the proposal is taken that agrees with most matches to ALL registered views.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
import poselib

from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import bundle
from splatnode.recon.registration.tracks import Tracks

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Pairs = Mapping[tuple[int, int], TwoView]

FAR_PX = 5.0  # parallax below which the sign of a depth means nothing


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_error_px: float = 2.5  # of a match that agrees, at 1024 px on the longer side
    min_points: int = 15  # 2D-3D inliers that a proposal needs
    min_inlier_ratio: float = 0.2
    ample_points: int = 40  # 2D-3D inliers from which on no pair needs to be asked for its relative pose
    min_scale_points: int = 5  # that must agree on the distance along the direction that a pair gives


@dataclass(frozen=True, eq=False)
class Placement:
    rotation: Array  # (3, 3) world to camera
    translation: Array  # (3,)
    support: float  # matches and points that agree
    share: float  # of all that could


@dataclass(frozen=True, eq=False)
class Known:
    """The map's points that a view observes."""

    pixels: Array  # (M, 2) relative to the principal point
    points: Array  # (M, 3)
    tracks: Index  # (M,)


def place(
    problem: bundle.Problem,
    all_tracks: Tracks,
    track_of_point: Index,
    view: int,
    registered: Sequence[int],
    pairs: Pairs,
    scale: Array,  # (C,) longer side of each view over 1024
    config: Config,
) -> Placement | None:
    """The best supported pose of `view`, or None when no proposal has enough support."""
    known = _known(problem, all_tracks, track_of_point, view)
    neighbours = {
        other: pairs[min(view, other), max(view, other)]
        for other in registered
        if (min(view, other), max(view, other)) in pairs
    }
    limit = config.max_error_px * scale[view]
    focal = float(np.exp(problem.log_focals[problem.lens_of_camera[view]]))
    available = max(1, len(known.tracks) + sum(len(pair.matches) for pair in neighbours.values()))
    best: Placement | None = None
    for rotation, translation in _proposals(problem, all_tracks, known, view, neighbours, limit, config):
        error = reprojection_errors(known, rotation, translation, focal)
        support = float((error < 3.0 * limit).sum())
        proposed = with_pose(problem, view, rotation, translation)
        for other, pair in neighbours.items():
            errors = pair_errors(proposed, (min(view, other), max(view, other)), pair)
            support += float((errors < 2.0 * limit).sum())
        if best is None or support > best.support:
            best = Placement(rotation, translation, support, support / available)
    return best


def with_pose(problem: bundle.Problem, view: int, rotation: Array, translation: Array) -> bundle.Problem:
    """The problem with another pose of `view`, world to camera."""
    rotations, translations = problem.rotations.copy(), problem.translations.copy()
    rotations[view], translations[view] = rotation, translation
    return replace(problem, rotations=rotations, translations=translations)


def relative_pose(pair: TwoView, focal1: float, focal2: float, limit: float) -> tuple[Array, Array, int]:
    """Rotation (3, 3) and direction (3,) of the pair's second camera for known focal lengths, and the inliers."""
    pose, info = poselib.estimate_relative_pose(
        pair.points1,
        pair.points2,
        _pinhole(focal1),
        _pinhole(focal2),
        {"max_epipolar_error": limit, "seed": 0, "min_iterations": 100, "max_iterations": 5000},
    )
    return np.asarray(pose.R), np.asarray(pose.t), int(sum(info["inliers"]))


def pair_errors(problem: bundle.Problem, key: tuple[int, int], pair: TwoView) -> Array:
    """(M,) Sampson errors of a pair's matches, pixels; infinite for what is not in front of both cameras."""
    rays = []
    for view, points in zip(key, (pair.points1, pair.points2), strict=True):
        normalised = normalise(problem, np.full(len(points), view), points)
        rays.append(np.column_stack([normalised, np.ones(len(points))]))
    rotation = problem.rotations[key[1]] @ problem.rotations[key[0]].T
    translation = problem.translations[key[1]] - rotation @ problem.translations[key[0]]
    essential = bundle.cross_matrix(translation[None])[0] @ rotation
    line2, line1 = rays[0] @ essential.T, rays[1] @ essential
    residual = np.abs((rays[1] * line2).sum(1))
    focal1, focal2 = np.exp(problem.log_focals[problem.lens_of_camera[list(key)]])
    gradient = (line2[:, :2] ** 2).sum(1) / focal2**2 + (line1[:, :2] ** 2).sum(1) / focal1**2
    errors = residual / np.sqrt(np.maximum(gradient, 1e-30))
    # Depths along both rays where they come closest: depth1 * R ray1 + t = depth2 * ray2.
    turned = rays[0] @ rotation.T
    across = _cross(rays[1], turned)
    parallax = np.linalg.norm(across, axis=1)
    depth1 = -(across * _cross(rays[1], translation)).sum(1)
    depth2 = -(across * _cross(turned, translation)).sum(1)
    in_front = ((depth1 > 0) & (depth2 > 0)) | (parallax < FAR_PX / max(focal1, focal2))
    return np.where(in_front, errors, np.inf)


def normalise(problem: bundle.Problem, camera: Index, pixels: Array) -> Array:
    """Coordinates (M, 2) at depth 1, without distortion, of `pixels` (M, 2) of the cameras `camera` (M,)."""
    lens = problem.lens_of_camera[camera]
    distorted = (pixels - problem.shifts[lens]) / np.exp(problem.log_focals[lens])[:, None]
    result = distorted
    for _ in range(5 if np.any(problem.radials) else 0):  # fixed-point iteration
        result = distorted / (1.0 + problem.radials[lens] * (result**2).sum(1))[:, None]
    return result


def reprojection_errors(known: Known, rotation: Array, translation: Array, focal: float) -> Array:
    """(M,) pixels without distortion; infinite behind the camera."""
    in_camera = known.points @ rotation.T + translation
    depth = np.maximum(in_camera[:, 2:], 1e-9)
    error = np.linalg.norm(in_camera[:, :2] / depth * focal - known.pixels, axis=1)
    return np.where(in_camera[:, 2] > 0, error, np.inf)


def _known(problem: bundle.Problem, all_tracks: Tracks, track_of_point: Index, view: int) -> Known:
    mine = all_tracks.camera_of == view
    tracks, pixels = all_tracks.track_of[mine], all_tracks.pixels[mine]
    if len(track_of_point) == 0:
        return Known(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, np.int64))
    position = np.minimum(np.searchsorted(track_of_point, tracks), len(track_of_point) - 1)
    found = track_of_point[position] == tracks
    return Known(pixels[found], problem.points[position[found]], tracks[found])


def _proposals(
    problem: bundle.Problem,
    all_tracks: Tracks,
    known: Known,
    view: int,
    neighbours: Mapping[int, TwoView],
    limit: float,
    config: Config,
) -> Iterator[tuple[Array, Array]]:
    """Poses from all known points, from those that one neighbour sees too, and from a pair and the points' scale."""
    focals = np.exp(problem.log_focals[problem.lens_of_camera])
    most = 0
    strongest = sorted(neighbours, key=lambda other: -len(neighbours[other].matches))[:4]
    everything = np.ones(len(known.tracks), bool)
    seen_by = [np.isin(known.tracks, all_tracks.track_of[all_tracks.camera_of == other]) for other in strongest]
    for chosen in (everything, *seen_by):
        if chosen.sum() < config.min_points:
            continue
        pose, info = poselib.estimate_absolute_pose(
            known.pixels[chosen],
            known.points[chosen],
            _pinhole(float(focals[view])),
            {"max_reproj_error": 3.0 * limit, "seed": 0, "min_iterations": 200, "max_iterations": 5000},
        )
        num_inliers = int(sum(info["inliers"]))
        if num_inliers >= max(config.min_points, config.min_inlier_ratio * chosen.sum()):
            most = max(most, num_inliers)
            yield np.asarray(pose.R), np.asarray(pose.t)
    if most >= config.ample_points:
        return
    for other, chosen in zip(strongest, seen_by, strict=True):
        if chosen.sum() < config.min_scale_points:
            continue
        first, second = min(view, other), max(view, other)
        rotation, direction, num_inliers = relative_pose(
            neighbours[other], float(focals[first]), float(focals[second]), limit
        )
        if num_inliers < 2 * config.min_points:
            continue
        if view == first:  # The pair leads from the view to its neighbour: turned round.
            rotation, direction = rotation.T, -rotation.T @ direction
        in_other = known.points[chosen] @ problem.rotations[other].T + problem.translations[other]
        rays = known.pixels[chosen] / focals[view]
        length = _scale(in_other @ rotation.T, direction, rays, limit / focals[view], config.min_scale_points)
        if length is None:
            continue
        yield rotation @ problem.rotations[other], rotation @ problem.translations[other] + length * direction


def _scale(turned: Array, direction: Array, rays: Array, limit: float, min_points: int) -> float | None:
    """The s for which most `turned + s * direction` (M, 3) project to `rays` (M, 2), or None when few agree.

    Points that lie on their ray for no s at all are wrong matches and say nothing about it.
    """
    rays3 = np.column_stack([rays, np.ones(len(rays))])
    across = _cross(rays3, direction)
    lengths = -(_cross(rays3, turned) * across).sum(1) / np.maximum((across**2).sum(1), 1e-12)

    def agree(moved: Array) -> npt.NDArray[np.bool_]:
        depth = moved[..., 2:]
        error = np.linalg.norm(moved[..., :2] / np.maximum(depth, 1e-9) - rays, axis=-1)
        return (error < 4.0 * limit) & (depth[..., 0] > 0)

    possible = lengths[(lengths > 0) & agree(turned + lengths[:, None] * direction)]
    if len(possible) == 0:
        return None
    counts = agree(turned[None] + possible[:, None, None] * direction).sum(1)
    best = int(counts.argmax())
    return float(possible[best]) if counts[best] >= max(min_points, 0.4 * len(possible)) else None


def _cross(one: Array, other: Array) -> Array:
    """(M, 3) products of rows with rows or with one vector; numpy.cross takes five times as long."""
    a, b = one.T, other.T
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], axis=1)


def _pinhole(focal: float) -> dict[str, object]:
    """PoseLib's camera for pixels relative to the principal point."""
    return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal, 0, 0]}
