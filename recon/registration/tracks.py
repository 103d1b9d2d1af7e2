"""Tracks: the pixels, in several frames, that pairwise matches say are one point of the scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from recon.registration.two_view import TwoView

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Tracks:
    """O observations of T tracks, ordered by track."""

    camera_of: Index  # (O,)
    track_of: Index  # (O,) in [0, T)
    pixels: Array  # (O, 2) relative to the principal point of the camera
    num_tracks: int


def build(points: Sequence[Array], pairs: Mapping[tuple[int, int], TwoView]) -> Tracks:
    """Connected components of the matches. `points[i]` (M, 2) are the centred feature pixels of frame i.

    Where a component holds two features of one frame, that frame's observations of it contradict each other and go.
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
    alone = count[group] == 1
    node, camera, track = node[alone], camera[alone], track[alone]
    kept, track, count = np.unique(track, return_inverse=True, return_counts=True)
    seen_twice = count[track] >= 2
    node, camera, track = node[seen_twice], camera[seen_twice], track[seen_twice]
    kept, track = np.unique(track, return_inverse=True)
    order = np.lexsort((camera, track))
    pixels = np.concatenate([np.asarray(frame_points) for frame_points in points])[node]
    return Tracks(camera[order].astype(np.int64), track[order].astype(np.int64), pixels[order], len(kept))


def thin(tracks: Tracks, num_cameras: int, per_camera: int) -> Tracks:
    """The tracks that are among the `per_camera` longest of at least one of their cameras (ties: spread evenly)."""
    length = np.bincount(tracks.track_of, minlength=tracks.num_tracks)
    shuffled = np.random.default_rng(0).permutation(tracks.num_tracks)
    rank_of_track = np.empty(tracks.num_tracks, np.int64)
    rank_of_track[np.lexsort((shuffled, -length))] = np.arange(tracks.num_tracks)
    chosen = np.zeros(tracks.num_tracks, bool)
    for camera in range(num_cameras):
        mine = tracks.track_of[tracks.camera_of == camera]
        chosen[mine[np.argsort(rank_of_track[mine], kind="stable")[:per_camera]]] = True
    observed = chosen[tracks.track_of]
    _, track_of = np.unique(tracks.track_of[observed], return_inverse=True)
    return Tracks(tracks.camera_of[observed], track_of, tracks.pixels[observed], int(chosen.sum()))


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
