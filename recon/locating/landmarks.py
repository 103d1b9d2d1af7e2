"""The landmarks of a scene: gathered from its matches and its verified cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from splatnode.recon.keyframes import PLAIN, REFERENCE_SIDE, Keyframe, longer_side
from splatnode.recon.matching.features import DESCRIPTOR_SIZE
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration import bundle_adjustment, multiview_geometry
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.result.npz_files import DESCRIPTORS_A_PHOTOGRAPH, MOST_DESCRIPTORS
from splatnode.recon.result.snapshot import KnownLenses, Landmarks
from splatnode.recon.result.verdict import Bounds

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_UNKNOWN_DEG, _UNKNOWN_SHARE, _UNKNOWN_PERCENT = 180.0, 1.0, 100.0  # bounds of a camera of which nothing is claimed
_SAME_PX = 1e-6  # between an observation and the feature that it is of
_LEAST_CURVATURE = 1e-9  # of a point's information, relative to the largest: what is flatter is not known


def collect_landmarks(graph: ViewGraph, registration: Registration, bounds: Mapping[str, Bounds]) -> Landmarks:
    """The points that all matches and the registered cameras agree on, those first that most cameras see.

    Every camera keeps some: about DESCRIPTORS_A_PHOTOGRAPH descriptors a photograph are kept, over all photographs.
    """
    problem, centred = _triangulate_points(graph, registration)
    keyframes = [graph.keyframes[camera.index] for camera in registration.cameras]
    noise_px = _noise_px(problem, _scales(graph))
    covariances = _covariances(problem, noise_px * _scales(graph))
    camera_of, point_of, descriptors = _collect_descriptors(problem, graph, centred)
    kept = _select_descriptors(camera_of, point_of, len(problem.points), len(keyframes))
    numbers, point_of = np.unique(point_of[kept], return_inverse=True)
    position = np.full(len(graph.keyframes), -1)
    position[[camera.index for camera in registration.cameras]] = np.arange(len(keyframes))
    known = [bounds.get(keyframe.name) for keyframe in keyframes]
    return Landmarks(
        points=problem.points[numbers],
        covariances=covariances[numbers],
        descriptors=descriptors[kept],
        point_of=point_of,
        photograph_of=position[camera_of[kept]],
        names=tuple(keyframe.name for keyframe in keyframes),
        Ts_world_camera=np.stack([camera.T_world_camera for camera in registration.cameras]),
        lenses=_lenses(registration.cameras, keyframes),
        rotation_bounds=np.array([_UNKNOWN_DEG if each is None else each.rotation_deg for each in known]),
        centre_bounds=np.array([_UNKNOWN_SHARE if each is None else each.centre for each in known]),
        noise_px=noise_px,
        focal_bounds=np.array([_UNKNOWN_PERCENT if each is None else each.focal_percent for each in known]),
    )


def _scales(graph: ViewGraph) -> Array:
    """(K,) pixels of each keyframe for one at REFERENCE_SIDE."""
    return np.array([longer_side(keyframe.frame) / REFERENCE_SIDE for keyframe in graph.keyframes])


def _triangulate_points(graph: ViewGraph, registration: Registration) -> tuple[bundle_adjustment.Problem, list[Array]]:
    """All points on which matches and cameras agree, and the keyframes' features relative to the principal points."""
    count = len(graph.keyframes)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    log_focals, radials, principals = np.zeros(count), np.zeros((count, 2)), np.zeros((count, 2))
    for camera in registration.cameras:
        rotations[camera.index] = camera.T_world_camera[:3, :3].T
        translations[camera.index] = -rotations[camera.index] @ camera.T_world_camera[:3, 3]
        log_focals[camera.index], radials[camera.index] = np.log(camera.focal), camera.radial
        principals[camera.index] = camera.principal
    shifts = np.zeros((count, 2))
    problem = bundle_adjustment.make_empty_problem(
        rotations, translations, np.arange(count), log_focals, radials, shifts
    )
    aspects = {camera.index: camera.aspect for camera in registration.cameras}
    problem = replace(problem, log_aspects=np.log([aspects.get(index, 1.0) for index in range(count)]))
    centred = [keyframe.features.points - principals[i] for i, keyframe in enumerate(graph.keyframes)]
    registered = [camera.index for camera in registration.cameras]
    every = multiview_geometry.build(centred, graph.pairs)
    problem, _ = multiview_geometry.retriangulate(
        problem, every, registered, _scales(graph), multiview_geometry.TriangulationConfig(), tolerance=1.0
    )
    return problem, centred


def _collect_descriptors(
    problem: bundle_adjustment.Problem, graph: ViewGraph, centred: Sequence[Array]
) -> tuple[Index, Index, npt.NDArray[np.uint8]]:
    """Cameras (D,), points (D,) and descriptors (D, 128) of the observations whose features have a plain one.

    A keypoint with several orientations has several.
    """
    cameras, points = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    descriptors = [np.zeros((0, DESCRIPTOR_SIZE), np.uint8)]
    for camera in np.unique(problem.camera_of).tolist():
        plain = graph.keyframes[camera].features.select_tilt(PLAIN)
        (observations,) = np.nonzero(problem.camera_of == camera)
        if not len(plain.point_of):
            continue
        at = KDTree(centred[camera][plain.point_of]).query_ball_point(problem.pixels[observations], _SAME_PX)
        points.append(np.repeat(problem.point_of[observations], [len(found) for found in at]))
        cameras.append(np.full(len(points[-1]), camera))
        descriptors.append(plain.descriptors[np.array([i for found in at for i in found], np.int64)])
    return np.concatenate(cameras), np.concatenate(points), np.concatenate(descriptors)


def _noise_px(problem: bundle_adjustment.Problem, scales: Array) -> float:
    """The standard deviation of one component of an observation's error, pixels at REFERENCE_SIDE."""
    errors = bundle_adjustment.reprojection_errors(problem) / scales[problem.camera_of]
    median = float(np.median(errors)) if len(errors) else 1.0
    return bundle_adjustment.noise_px(len(problem.pixels), len(problem.points), median)


def _covariances(problem: bundle_adjustment.Problem, noise_px: Array) -> Array:
    """(P, 3, 3) of the points, the cameras taken as exact; `noise_px` (K,) is that of each camera."""
    by_point = _derivatives(problem) / noise_px[problem.camera_of, None, None]
    information = np.zeros((len(problem.points), 3, 3))
    np.add.at(information, problem.point_of, by_point.transpose(0, 2, 1) @ by_point)
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, _LEAST_CURVATURE * values[:, -1:])
    return (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)


def _derivatives(problem: bundle_adjustment.Problem) -> Array:
    """(O, 2, 3) of each observation's pixel by its point, without distortion, which changes them by percents."""
    rotations = problem.rotations[problem.camera_of]
    in_camera = np.einsum("oij,oj->oi", rotations, problem.points[problem.point_of])
    in_camera += problem.translations[problem.camera_of]
    x, y, z = in_camera.T
    zero = np.zeros_like(z)
    rows = np.stack([np.stack([1 / z, zero, -x / z**2], 1), np.stack([zero, 1 / z, -y / z**2], 1)], 1)
    return np.exp(problem.log_focals)[problem.camera_of, None, None] * rows @ rotations


def _select_descriptors(camera_of: Index, point_of: Index, num_points: int, num_cameras: int) -> npt.NDArray[np.bool_]:
    """(D,) which descriptors are kept: those of the points that rank first in one of their cameras.

    In a camera points rank by how many cameras see them, then by a fixed random order, which spreads them.
    """
    most = min(DESCRIPTORS_A_PHOTOGRAPH * num_cameras, MOST_DESCRIPTORS)
    length = np.bincount(point_of, minlength=num_points)
    order = np.lexsort((np.random.default_rng(0).permutation(num_points), -length))
    rank = np.empty(num_points, np.int64)
    rank[order] = np.arange(num_points)
    first = np.full(num_points, np.iinfo(np.int64).max)
    for camera in np.unique(camera_of):
        own = np.unique(point_of[camera_of == camera])
        own = own[np.argsort(rank[own])]
        first[own] = np.minimum(first[own], np.arange(len(own)))
    order = np.lexsort((rank, first))
    fits = np.cumsum(length[order]) <= most
    kept = np.zeros(num_points, bool)
    kept[order[fits]] = True
    return kept[point_of]


def _lenses(cameras: tuple[RegisteredCamera, ...], keyframes: list[Keyframe]) -> KnownLenses:
    sides = np.array([longer_side(keyframe.frame) for keyframe in keyframes])
    sizes = np.array([(keyframe.frame.width, keyframe.frame.height) for keyframe in keyframes], np.float64)
    principals = np.stack([camera.principal for camera in cameras])
    return KnownLenses(
        focals=np.array([camera.focal for camera in cameras]) / sides,
        radials=np.array([camera.radial for camera in cameras]),
        shifts=(principals - sizes / 2.0) / sides[:, None],
        shapes=sizes[:, 1] / sizes[:, 0],
    )
