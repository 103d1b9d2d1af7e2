"""Multi-view geometry: the relative pose of a pair and its matches' errors, and points from their tracks."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from splatnode.recon import poselib
from splatnode.recon.core import library, pointer
from splatnode.recon.geometry import undistort_iterations
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment

# Epipolar geometry of a pair whose focal lengths are known: relative pose, and the Sampson errors of matches.

Array = npt.NDArray[np.float64]

_MIN_PARALLAX_PX = 5.0  # below it, the noise of a match decides whether its point lies in front of the cameras
_ITERATIONS = {"min_iterations": 100, "max_iterations": 5000, "seed": 0}  # of RANSAC: 5000 do for 25 % inliers


def relative_pose(pair: TwoView, focal1: float, focal2: float, max_error_px: float) -> tuple[Array, Array, int]:
    """Pose of the second camera in the frame of the first, and the number of inliers, from five points (poselib).

    The rotation is (3, 3), from the first camera's axes to the second's; the translation (3,) has unknown length.
    `focal1`, `focal2` and `max_error_px` (Sampson) are in pixels.
    """
    pose, info = poselib.estimate_relative_pose(
        pair.points1,
        pair.points2,
        pinhole(focal1),
        pinhole(focal2),
        {"max_epipolar_error": max_error_px, **_ITERATIONS},
    )
    return np.asarray(pose.R), np.asarray(pose.t), int(sum(info["inliers"]))


def sampson_errors(estimate: bundle_adjustment.Problem, views: tuple[int, int], pair: TwoView) -> Array:
    """(M,) Sampson errors of the matches of `pair` under the estimated poses of its two views, pixels.

    Infinite where a match's point lies behind a camera (Hartley and Zisserman, 2004, 11.4.3 for the error).
    """
    first, second = views
    rotation = estimate.rotations[second] @ estimate.rotations[first].T
    lenses = estimate.lens_of_camera[list(views)]
    across, radials = np.exp(estimate.log_focals[lenses]), estimate.radials[lenses]
    focals = np.stack([across, across * estimate.aspects[lenses]], 1)
    pose = _Pose(
        tuple(rotation.ravel()),
        tuple(estimate.translations[second] - rotation @ estimate.translations[first]),
        tuple(focals.ravel()),
        tuple(radials.ravel()),
        tuple(estimate.shifts[lenses].ravel()),
        tuple(estimate.all_skews[lenses]),
        _MIN_PARALLAX_PX / focals.max(),
        undistort_iterations(radials),
    )
    points1, points2 = (np.ascontiguousarray(points, np.float64) for points in (pair.points1, pair.points2))
    errors = np.empty(len(points1))
    native = ctypes.byref(pose), pointer(points1), pointer(points2), len(points1), pointer(errors)
    library().core_sampson_errors(*native)
    return errors


class _Pose(ctypes.Structure):
    """`EpipolarPose` of recon/core/epipolar.cpp."""

    _fields_ = (
        ("rotation", ctypes.c_double * 9),
        ("translation", ctypes.c_double * 3),
        ("focals", ctypes.c_double * 4),
        ("radials", ctypes.c_double * 4),
        ("shifts", ctypes.c_double * 4),
        ("skews", ctypes.c_double * 2),
        ("min_parallax", ctypes.c_double),
        ("undistort_iterations", ctypes.c_int32),
    )


def pinhole(focal: float) -> dict[str, object]:
    """PoseLib's camera for pixels relative to the principal point; it does not read width and height."""
    return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal, 0, 0]}


# Triangulation: scene points from their tracks and the cameras' poses.

# Tracks: the observations, in several frames, that pairwise matches say are of one scene point.

Index = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Tracks:
    """O observations of T tracks, sorted by track."""

    camera_of: Index  # (O,)
    track_of: Index  # (O,) in [0, T)
    pixels: Array  # (O, 2) relative to the principal point of the camera
    num_tracks: int


def build(points: Sequence[Array], pairs: Mapping[tuple[int, int], TwoView]) -> Tracks:
    """Connected components of the matches of all pairs. `points[i]` (M, 2) are frame i's centred feature pixels.

    Where a component holds two features of one frame, that frame's observations of it contradict each other and are
    dropped; so are components that are left with one observation.
    """
    offsets = np.concatenate([[0], np.cumsum([len(frame_points) for frame_points in points])])
    if not pairs:
        return Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), 0)
    first = np.concatenate([view.matches[:, 0] + offsets[i] for (i, _), view in pairs.items()])
    second = np.concatenate([view.matches[:, 1] + offsets[j] for (_, j), view in pairs.items()])
    size = int(offsets[-1])
    _, label = connected_components(coo_matrix((np.ones(len(first)), (first, second)), (size, size)), directed=False)
    node = np.unique(np.concatenate([first, second]))
    camera, track = np.searchsorted(offsets, node, side="right") - 1, label[node]
    _, group, count = np.unique(track * len(points) + camera, return_inverse=True, return_counts=True)
    unique = count[group] == 1
    node, camera, track = node[unique], camera[unique], track[unique]
    _, track, count = np.unique(track, return_inverse=True, return_counts=True)
    observed_twice = count[track] >= 2
    node, camera, track = node[observed_twice], camera[observed_twice], track[observed_twice]
    kept, track = np.unique(track, return_inverse=True)
    order = np.lexsort((camera, track))
    pixels = np.concatenate([np.asarray(frame_points) for frame_points in points])[node]
    return Tracks(camera[order].astype(np.int64), track[order].astype(np.int64), pixels[order], len(kept))


def thin(tracks: Tracks, per_camera: int) -> Tracks:
    """The tracks that `longest` chooses."""
    chosen = longest(tracks.camera_of, tracks.track_of, tracks.num_tracks, per_camera)
    observed = chosen[tracks.track_of]
    _, track_of = np.unique(tracks.track_of[observed], return_inverse=True)
    return Tracks(tracks.camera_of[observed], track_of, tracks.pixels[observed], int(chosen.sum()))


def longest(camera_of: Index, track_of: Index, num_tracks: int, per_camera: int) -> npt.NDArray[np.bool_]:
    """(T,) whether a track is among the `per_camera` longest of at least one of its cameras.

    `camera_of` (O,) and `track_of` (O,) are the observations. Among tracks of one length a fixed random order decides,
    which spreads them over the image.
    """
    length = np.bincount(track_of, minlength=num_tracks)
    shuffled = np.random.default_rng(0).permutation(num_tracks)
    rank = np.empty(num_tracks, np.int64)
    rank[np.lexsort((shuffled, -length))] = np.arange(num_tracks)
    chosen = np.zeros(num_tracks, bool)
    for camera in np.unique(camera_of):
        own = track_of[camera_of == camera]
        chosen[own[np.argsort(rank[own], kind="stable")[:per_camera]]] = True
    return chosen


Index32 = npt.NDArray[np.int32]


_ROUNDS = 3  # of triangulation: the worst observation of a track is left out twice at most


class TriangulationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Triangulation: scene points from their tracks and the cameras' poses."""

    max_error_px: float = 2.5  # reprojection error of a kept observation, pixels at REFERENCE_SIDE
    min_angle_deg: float = 1.0  # triangulation angle: the widest between two rays of a kept point


def triangulate(matrices: Array, rays: Array, camera_of: Index, track_of: Index, num_tracks: int) -> Array:
    """(T, 3) points by the direct linear transform (Hartley and Zisserman, 2004, 12.2).

    `rays` (O, 2) are normalised image coordinates, `matrices` (C, 3, 4) world to camera. A point with fewer than two
    observations, or at infinity, is NaN.
    """
    cameras, (rays,), first = _sort_by_point(camera_of, track_of, num_tracks, rays)
    matrices, points = np.ascontiguousarray(matrices), np.empty((num_tracks, 3))
    native = pointer(matrices), pointer(rays), pointer(cameras), pointer(first), num_tracks, pointer(points)
    library().core_triangulate(*native)
    return points


def largest_angles(centres: Array, points: Array, camera_of: Index, track_of: Index) -> Array:
    """(T,) triangulation angles: the widest between two rays of each of `points` (T, 3), degrees.

    `centres` (C, 3) are those of the cameras.
    """
    cameras, _, first = _sort_by_point(camera_of, track_of, len(points))
    centres, points, cosines = np.ascontiguousarray(centres), np.ascontiguousarray(points), np.empty(len(points))
    native = pointer(centres), pointer(points), pointer(cameras), pointer(first), len(points), pointer(cosines)
    library().core_widest_angles(*native)
    return np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))


def _sort_by_point(
    camera_of: Index, point_of: Index, num_points: int, *values: Array
) -> tuple[Index32, list[Array], Index32]:
    """The cameras and `values` of observations in the order of their points, and where those of each point begin."""
    if np.any(np.diff(point_of) < 0):
        order = np.argsort(point_of, kind="stable")
        camera_of, point_of, values = camera_of[order], point_of[order], tuple(value[order] for value in values)
    first = np.searchsorted(point_of, np.arange(num_points + 1)).astype(np.int32)
    return np.ascontiguousarray(camera_of, np.int32), [np.ascontiguousarray(value) for value in values], first


def retriangulate(
    problem: bundle_adjustment.Problem,
    all_tracks: Tracks,
    registered: Sequence[int],
    scale: Array,
    config: TriangulationConfig,
    tolerance: float,
) -> tuple[bundle_adjustment.Problem, Index]:
    """The problem with all points that the registered cameras agree on, and the tracks of these (P,).

    An observation is kept up to `tolerance` times the largest error; `scale` (C,) is each view's longer side over
    REFERENCE_SIDE. The worst observation of a track that fails is left out and the track tried again.
    """
    own = np.isin(all_tracks.camera_of, registered)
    camera, track, pixels = all_tracks.camera_of[own], all_tracks.track_of[own], all_tracks.pixels[own]
    rays = bundle_adjustment.normalise(problem, camera, pixels)
    matrices = np.concatenate([problem.rotations, problem.translations[:, :, None]], 2)
    limit = tolerance * config.max_error_px * scale
    errors = np.zeros(0)
    points = np.zeros((all_tracks.num_tracks, 3))
    for _ in range(_ROUNDS):
        points = triangulate(matrices, rays, camera, track, all_tracks.num_tracks)
        errors = bundle_adjustment.reprojection_errors(
            replace(problem, points=np.nan_to_num(points), camera_of=camera, point_of=track, pixels=pixels)
        )
        errors = np.where(np.isnan(points[track, 0]), np.inf, errors) / limit[camera]
        worst = np.zeros(all_tracks.num_tracks)
        np.maximum.at(worst, track, errors)
        keep = (worst[track] <= 1.0) | (errors < worst[track])
        if keep.all():
            break
        camera, track, pixels, rays, errors = camera[keep], track[keep], pixels[keep], rays[keep], errors[keep]
    angles = largest_angles(bundle_adjustment.centres(problem), np.nan_to_num(points), camera, track)
    count = np.bincount(track, minlength=all_tracks.num_tracks)
    worst = np.zeros(all_tracks.num_tracks)
    np.maximum.at(worst, track, errors)
    good = (count >= 2) & (worst <= 1.0) & (angles >= config.min_angle_deg) & ~np.isnan(points[:, 0])
    (kept,) = np.nonzero(good)
    observed = good[track]
    return (
        replace(
            problem,
            points=points[kept],
            camera_of=camera[observed],
            point_of=np.searchsorted(kept, track[observed]),
            pixels=pixels[observed],
        ),
        kept,
    )
