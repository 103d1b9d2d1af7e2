"""Tracks: the observations, in several frames, that pairwise matches say are of one scene point."""

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
