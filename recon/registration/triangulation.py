"""Triangulation: scene points from their tracks and the cameras' poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, pointer
from splatnode.recon.registration import bundle
from splatnode.recon.registration.tracks import Tracks

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Index32 = npt.NDArray[np.int32]


_ROUNDS = 3  # of triangulation: the worst observation of a track is left out twice at most


class TriangulationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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
    problem: bundle.Problem,
    all_tracks: Tracks,
    registered: Sequence[int],
    scale: Array,
    config: TriangulationConfig,
    tolerance: float,
) -> tuple[bundle.Problem, Index]:
    """The problem with all points that the registered cameras agree on, and the tracks of these (P,).

    An observation is kept up to `tolerance` times the largest error; `scale` (C,) is each view's longer side over
    REFERENCE_SIDE. The worst observation of a track that fails is left out and the track tried again.
    """
    own = np.isin(all_tracks.camera_of, registered)
    camera, track, pixels = all_tracks.camera_of[own], all_tracks.track_of[own], all_tracks.pixels[own]
    rays = bundle.normalise(problem, camera, pixels)
    matrices = np.concatenate([problem.rotations, problem.translations[:, :, None]], 2)
    limit = tolerance * config.max_error_px * scale
    errors = np.zeros(0)
    points = np.zeros((all_tracks.num_tracks, 3))
    for _ in range(_ROUNDS):
        points = triangulate(matrices, rays, camera, track, all_tracks.num_tracks)
        errors = bundle.reprojection_errors(
            replace(problem, points=np.nan_to_num(points), camera_of=camera, point_of=track, pixels=pixels)
        )
        errors = np.where(np.isnan(points[track, 0]), np.inf, errors) / limit[camera]
        worst = np.zeros(all_tracks.num_tracks)
        np.maximum.at(worst, track, errors)
        keep = (worst[track] <= 1.0) | (errors < worst[track])
        if keep.all():
            break
        camera, track, pixels, rays, errors = camera[keep], track[keep], pixels[keep], rays[keep], errors[keep]
    angles = largest_angles(bundle.centres(problem), np.nan_to_num(points), camera, track)
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
