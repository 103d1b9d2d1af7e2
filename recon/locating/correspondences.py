"""Which pixels of a photograph may show which landmarks: its features matched with those of each known photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Features
from splatnode.recon.matching import nearest_neighbours
from splatnode.recon.result.landmarks import Landmarks

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

_MIN_LENGTH = 1e-12


@dataclass(frozen=True, eq=False)
class Correspondences:
    """M pixels of a photograph with the landmarks that they may show. A pixel may have several of them."""

    pixels: Array  # (M, 2) relative to the nominal principal point
    feature_of: Index  # (M,) the photograph's feature
    points: Array  # (M, 3) world
    covariances: Array  # (M, 3, 3) of the points
    landmark_of: Index  # (M,)
    photograph_of: Index  # (M,) a known photograph that says so
    seen_along: Array  # (M, 3) the mean direction in which those that say so see the landmark, of unit length, world

    def __len__(self) -> int:
        return len(self.pixels)

    def of(self, chosen: Flags | Index) -> Correspondences:
        """The chosen ones."""
        return Correspondences(
            *(getattr(self, name)[chosen] for name in Correspondences.__dataclass_fields__),
        )


def correspondences(
    features: Features, principal: Array, landmarks: Landmarks, config: nearest_neighbours.Config
) -> Correspondences:
    """The matches of the plain `features` with the descriptors of each known photograph by itself.

    In the photographs together a landmark is its own second-nearest neighbour, and the ratio test would fail.
    """
    found = [np.zeros((0, 3), np.int64)]
    for photograph in range(len(landmarks.Ts_world_camera)):
        (own,) = np.nonzero(landmarks.photograph_of == photograph)
        matches = nearest_neighbours.match(features.descriptors, landmarks.descriptors[own], config)
        points = landmarks.point_of[own[matches[:, 1]]]
        shown = features.point_of[matches[:, 0]]
        found.append(np.column_stack([shown, points, np.full(len(matches), photograph)]))
    every = np.concatenate(found)
    pairs, first, pair_of = np.unique(every[:, :2], axis=0, return_index=True, return_inverse=True)
    feature_of, landmark_of = pairs.T
    along = _directions(landmarks.points[every[:, 1]] - landmarks.Ts_world_camera[every[:, 2], :3, 3])
    seen_along = np.zeros((len(pairs), 3))
    np.add.at(seen_along, pair_of.ravel(), along)
    return Correspondences(
        pixels=features.points[feature_of] - principal,
        feature_of=feature_of,
        points=landmarks.points[landmark_of],
        covariances=landmarks.covariances[landmark_of],
        landmark_of=landmark_of,
        photograph_of=every[first, 2],
        seen_along=_directions(seen_along),
    )


def _directions(vectors: Array) -> Array:
    """The vectors (M, 3) in unit length."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), _MIN_LENGTH)
