"""Points of the scene from their tracks, given cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle, resection
from splatnode.recon.registration.tracks import Tracks

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_error_px: float = 2.5  # reprojection error of a kept observation, at 1024 px on the longer side
    min_angle_deg: float = 1.0  # between the rays of a kept point


def triangulate(matrices: Array, rays: Array, camera_of: Index, track_of: Index, num_tracks: int) -> Array:
    """(T, 3) points by the direct linear transform from `rays` (O, 2), normalised image coordinates.

    `matrices` (C, 3, 4) are world to camera. A track with no observation, or one at infinity, is NaN.
    """
    rows = rays[:, :, None] * matrices[camera_of, 2][:, None, :] - matrices[camera_of, :2]
    rows /= np.linalg.norm(rows, axis=2, keepdims=True)
    normal = np.einsum("oki,okj->oij", rows, rows)
    index = track_of[:, None, None] * 16 + np.arange(16).reshape(4, 4)
    summed = np.bincount(index.ravel(), weights=normal.ravel(), minlength=num_tracks * 16).reshape(-1, 4, 4)
    homogeneous = np.linalg.eigh(summed)[1][:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        points = homogeneous[:, :3] / homogeneous[:, 3:]
    observed = np.bincount(track_of, minlength=num_tracks) >= 2
    return np.where((np.abs(homogeneous[:, 3:]) > 1e-12) & observed[:, None], points, np.nan)


def largest_angles(centres: Array, points: Array, camera_of: Index, track_of: Index) -> Array:
    """(T,) the widest angle, in degrees, between two rays that meet in each of `points` (T, 3)."""
    directions = np.zeros((len(points), len(centres), 3))
    towards = points[track_of] - centres[camera_of]
    directions[track_of, camera_of] = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    seen = np.zeros((len(points), len(centres)), bool)
    seen[track_of, camera_of] = True
    cosine = np.where(seen[:, :, None] & seen[:, None, :], directions @ directions.transpose(0, 2, 1), 1.0)
    return np.degrees(np.arccos(np.clip(cosine.min(axis=(1, 2)), -1.0, 1.0)))


def retriangulate(
    problem: bundle.Problem,
    all_tracks: Tracks,
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
    rays = resection.normalise(problem, camera, pixels)
    matrices = np.concatenate([problem.rotations, problem.translations[:, :, None]], 2)
    limit = widen * config.max_error_px * scale
    errors = np.zeros(0)
    points = np.zeros((all_tracks.num_tracks, 3))
    for _ in range(3):
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
    centres = -np.einsum("cji,cj->ci", problem.rotations, problem.translations)
    angles = largest_angles(centres, np.nan_to_num(points), camera, track)
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
