"""Tracks: the pixels, in several frames, that pairwise matches say are one point of the scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from splatnode.recon.matching.two_view import TwoView

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
