"""Which pixels of a photograph may show which landmarks: its features matched with those of each known photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import PLAIN, Features
from splatnode.recon.locating.camera_model import CameraModel
from splatnode.recon.matching import nearest_neighbours
from splatnode.recon.result.landmarks import Landmarks
from splatnode.recon.verification.reflection import ReflectionConfig, mirror_descriptors

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

LEAST_COSINE = 0.5  # between two directions from which a feature looks alike: 60 degrees are beyond SIFT's reach
_NEAREST = 4  # photographs of the scene that one is compared with whose camera is nearly known
_MARGIN = 0.15  # of the longer side, around the picture: what is there may be in it
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

    def select(self, chosen: Flags | Index) -> Correspondences:
        """The chosen ones."""
        return Correspondences(
            *(getattr(self, name)[chosen] for name in Correspondences.__dataclass_fields__),
        )


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A prior on the camera's pose."""

    camera: CameraModel
    size: tuple[int, int]  # (width, height) of its picture, pixels
    reach_px: float | None = None  # a landmark is at most so far from where the camera sees it; None: anywhere


def match_landmarks(
    features: Features,
    principal: Array,
    landmarks: Landmarks,
    config: nearest_neighbours.NearestNeighbourConfig,
    near: PosePrior | None = None,
) -> Correspondences:
    """The matches of the plain `features` with the descriptors of each known photograph by itself.

    In the photographs together a landmark is its own second-nearest neighbour, and the ratio test would fail. Where the
    camera is nearly known, the photographs are those that look most alike, and the landmarks those that it sees, from
    nearly the same side.
    """
    count = len(landmarks.Ts_world_camera)
    photographs = range(count) if near is None else _nearest(landmarks, near.camera.T_world_camera)
    in_view, shown = (None, None) if near is None else _find_visible(landmarks, principal, near)
    at = features.points[features.point_of]
    ours, theirs = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for photograph in photographs:
        (own,) = np.nonzero(landmarks.photograph_of == photograph)
        if near is not None and in_view is not None:
            own = own[in_view[own]]
        described = landmarks.descriptors[own]
        if near is None or near.reach_px is None or shown is None:
            matches = nearest_neighbours.match(features.descriptors, described, config)
        else:
            there = shown[landmarks.point_of[own]]
            matches = nearest_neighbours.match_near(features.descriptors, at, described, there, near.reach_px, config)
        ours.append(features.point_of[matches[:, 0]])
        theirs.append(own[matches[:, 1]])
    return _each_once(np.concatenate(ours), np.concatenate(theirs), features.points - principal, landmarks)


def measure_mirror_gain(features: Features, landmarks: Landmarks, config: ReflectionConfig) -> float:
    """How much better the plain `features` match the scene when the image is turned left to right.

    It is the logarithm of the matches mirrored over those as it is (recon/verification/reflection.py), each with those
    images of the scene with which it has most. In a symmetric place these are not the same.
    """
    plain = features.select_tilt(PLAIN).descriptors[: config.num_features]
    counts = np.zeros((len(landmarks.names), 2))  # as it is, and mirrored
    for photograph in range(len(counts)):
        theirs = landmarks.descriptors[landmarks.photograph_of == photograph]
        for way, ours in enumerate((plain, mirror_descriptors(plain))):
            counts[photograph, way] = len(nearest_neighbours.match(theirs, ours, config.nearest_neighbours))
    as_it_is, mirrored = np.sort(counts, axis=0)[-config.partners :].mean(0) + config.by_chance
    return float(np.log(mirrored / as_it_is))


def _find_visible(landmarks: Landmarks, principal: Array, near: PosePrior) -> tuple[Flags, Array]:
    """(D,) which descriptors are of points that the camera sees as they were seen; (P, 2) where it sees each point."""
    shown, depth = near.camera.project(landmarks.points)
    shown, margin = shown + principal, near.reach_px or _MARGIN * max(near.size)
    inside = (depth > 0) & (shown > -margin).all(1) & (shown < np.array(near.size) + margin).all(1)
    points = landmarks.points[landmarks.point_of]
    before = _directions(points - landmarks.Ts_world_camera[landmarks.photograph_of, :3, 3])
    now = _directions(points - near.camera.T_world_camera[:3, 3])
    return inside[landmarks.point_of] & ((before * now).sum(1) > LEAST_COSINE), shown


def _nearest(landmarks: Landmarks, T_world_camera: Array) -> Index:
    """The photographs of the scene that look most alike: a radian counts as much as the distance to the scene."""
    Ts = landmarks.Ts_world_camera
    turn = np.arccos(np.clip(Ts[:, :3, 2] @ T_world_camera[:3, 2], -1.0, 1.0))
    apart = np.linalg.norm(Ts[:, :3, 3] - T_world_camera[:3, 3], axis=1) / landmarks.unit
    return np.argsort(turn + apart, kind="stable")[:_NEAREST]


def _each_once(feature_of: Index, descriptor_of: Index, pixels: Array, landmarks: Landmarks) -> Correspondences:
    """Each feature, which lies at `pixels`, with each landmark that it may show, once."""
    photograph_of = landmarks.photograph_of[descriptor_of]
    both = np.column_stack([feature_of, landmarks.point_of[descriptor_of]])
    pairs, first, pair_of = np.unique(both, axis=0, return_index=True, return_inverse=True)
    feature_of, landmark_of = pairs.T
    along = _directions(landmarks.points[both[:, 1]] - landmarks.Ts_world_camera[photograph_of, :3, 3])
    seen_along = np.zeros((len(pairs), 3))
    np.add.at(seen_along, pair_of.ravel(), along)
    return Correspondences(
        pixels=pixels[feature_of],
        feature_of=feature_of,
        points=landmarks.points[landmark_of],
        covariances=landmarks.covariances[landmark_of],
        landmark_of=landmark_of,
        photograph_of=photograph_of[first],
        seen_along=_directions(seen_along),
    )


def _directions(vectors: Array) -> Array:
    """The vectors (M, 3) in unit length."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), _MIN_LENGTH)
