"""Where in a finished scene a photograph was taken that was not in the set, or why that cannot be said.

Its features are matched with the scene's landmarks, a pose is found on which most of them agree, and everything that
speaks against it is asked (verification.py): being wrong is worse than refusing.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.lenses import assign_lens, check_fits, read_lens, same_aspect, undistort_frame
from splatnode.capture.process.terminal import say
from splatnode.recon.geometry import compute_rms_radius
from splatnode.recon.keyframes import PLAIN, REFERENCE_SIDE, Features, Keyframe, longer_side, principal_point
from splatnode.recon.locating import LensSource, Located, NotLocated, Reason, pose_refinement, verification
from splatnode.recon.locating.pose_refinement import (
    CameraModel,
    Correspondences,
    LensAssumption,
    PosePrior,
    match_landmarks,
    measure_mirror_gain,
)
from splatnode.recon.locating.verification import (
    PoseHypothesis,
    QueryContext,
    choose_lens,
    search_cameras,
    search_cameras_longer,
)
from splatnode.recon.matching import features as matching_features
from splatnode.recon.matching.features import DESCRIPTOR_SIZE
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration import bundle_adjustment, multiview_geometry
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.snapshot import KnownLenses, Landmarks
from splatnode.recon.result.stored_snapshot import DESCRIPTORS_A_PHOTOGRAPH, MOST_DESCRIPTORS, read_landmarks
from splatnode.recon.result.verdict import Bounds

# The landmarks of a scene: gathered from its matches and its verified cameras.

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
    log_aspects, skews = np.zeros(count), np.zeros(count)
    for camera in registration.cameras:
        log_aspects[camera.index], skews[camera.index] = np.log(camera.aspect), camera.skew
    problem = replace(problem, log_aspects=log_aspects, skews=skews)
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


# Where in a finished scene a photograph was taken that was not in the set, or why that cannot be said.


_AMPLE_GUIDED = 300  # points that agree: with fewer, landmarks are looked for again
_MAX_GUIDED_BY_CHANCE = 0.1  # of what agrees then
REACH = 0.02  # of the longer side: how far from where a camera sees it a landmark is looked for
_AMPLE_NFA, _AMPLE_POINTS = -30.0, 100  # log10, and points that agree: so surely is no longer search needed

# What is said of an image whose pixels are not square; a lens of its own may be wrong of one, too. Then so many times
# as many points must agree.
_OF_STRETCHED, _MORE_STRETCHED = (Reason.ELSEWHERE, Reason.INCONSISTENT, Reason.LENS), 1.25


# Points of an image that two others see, by which its shear is measured; of more, an even choice
LEAST_CONFIRMED, _MOST_CONFIRMED = 60, 400
_SIGMAS = 1.0  # of a shear: it widens bounds, and names what was refused
_SETTLED = pose_refinement.PoseSearchConfig(rounds=2)


def measure_shears(graph: ViewGraph, registration: Registration) -> dict[str, float]:
    """Measures the shears of registered images, by name, as `verification.measure_shear`; few points measure none.

    A skew that a camera has is no shear of its image.
    """
    shears: dict[str, float] = {}
    times_seen = np.bincount(registration.observed_point, minlength=len(registration.points))
    for camera in registration.cameras:
        frame = graph.keyframes[camera.index].frame
        (mine,) = np.nonzero(
            (registration.observed_by == camera.index) & (times_seen[registration.observed_point] >= 3)
        )
        if len(mine) < LEAST_CONFIRMED:
            continue
        mine = mine[:: -(-len(mine) // _MOST_CONFIRMED)]
        count = len(mine)
        points, numbers = registration.points[registration.observed_point[mine]], np.arange(count)
        pixels = registration.observed_pixels[mine] - principal_point(frame)
        below = (registration.observed_pixels[mine, 1] - camera.principal[1]) / camera.aspect
        pixels[:, 0] -= camera.skew * below
        known = Correspondences(
            pixels=pixels,
            feature_of=numbers,
            points=points,
            covariances=np.zeros((count, 3, 3)),
            landmark_of=registration.observed_point[mine],
            photograph_of=np.zeros(count, np.int64),
            seen_along=points - camera.T_world_camera[:3, 3],
        )
        size = frame.width, frame.height
        judged = QueryContext(known, *size, registration.rms_px, 1.0, _SETTLED)
        rotation = camera.T_world_camera[:3, :3].T
        lens = pose_refinement.Lens(
            float(np.sqrt(np.prod(camera.focals))),
            (float(camera.radial[0]), float(camera.radial[1])),
            camera.principal - principal_point(frame),
            *(0.0, 0.0, 0.0),
            log_aspect=float(np.log(camera.focals[0] / camera.focals[1])),
        )
        model = CameraModel(rotation, -rotation @ camera.T_world_camera[:3, 3], lens)
        shears[graph.keyframes[camera.index].name] = verification.measure_shear(judged, model, _SIGMAS)
    return shears


class LocalizationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Localization of a query image in a saved scene, or the reason why it cannot be said."""

    features: matching_features.FeatureConfig = matching_features.FeatureConfig()
    neighbours: matching_features.NearestNeighbourConfig = matching_features.NearestNeighbourConfig()
    posing: pose_refinement.PoseSearchConfig = pose_refinement.PoseSearchConfig()
    checks: verification.LocalizationCheckConfig = verification.LocalizationCheckConfig()


@dataclass(frozen=True, eq=False)
class QueryImage:
    """A photograph without distortion, with its features."""

    frame: Frame
    features: Features


@dataclass(frozen=True, eq=False)
class Localization:
    """A photograph that was placed, with what placed it."""

    located: Located
    camera: CameraModel
    seen: Correspondences  # what agrees with the camera: each landmark, and each of the photograph's features, once
    size: tuple[int, int]  # (width, height) of the photograph, pixels
    spread: float  # RMS distance of the scene's cameras from their middle, in the unit of the result


def localize_image(
    landmarks: Landmarks,
    image: npt.NDArray[np.uint8],  # (H, W, 3) RGB
    intrinsics: Intrinsics | None = None,
    config: LocalizationConfig = LocalizationConfig(),  # noqa: B008 (it is frozen)
) -> Located | NotLocated:
    """The camera of `image` in the world of the landmarks, with what is claimed of it; else why there is none.

    `intrinsics` are those of the image, if they are known; a lens with distortion needs them, and the camera is that of
    the image without it. Without them the lenses of the scene's own photographs are tried first, then any. Raises
    ValueError for an image that is not (H, W, 3) uint8, or intrinsics that cannot be used.
    """
    return localize_query(landmarks, prepare_query_image(image, intrinsics, config), config)


def prepare_query_image(
    image: npt.NDArray[np.uint8],
    intrinsics: Intrinsics | None = None,
    config: LocalizationConfig = LocalizationConfig(),  # noqa: B008
    name: str = "photograph",
) -> QueryImage:
    """Prepares a query image, which may be localized in several scenes. Arguments as for `localize_image`.

    `name` is what the sentence of a ValueError calls the photograph.
    """
    frame = undistort_frame(Frame(0, name, 0, image, intrinsics))
    return QueryImage(frame, matching_features.extract(frame.image, config.features))


def localize_query(
    landmarks: Landmarks,
    photograph: QueryImage,
    config: LocalizationConfig = LocalizationConfig(),  # noqa: B008
) -> Located | NotLocated:
    """As `localize_image`."""
    found = localize_with_inliers(landmarks, photograph, config)
    return found.located if isinstance(found, Localization) else found


def localize_with_inliers(
    landmarks: Landmarks,
    photograph: QueryImage,
    config: LocalizationConfig = LocalizationConfig(),  # noqa: B008
) -> Localization | NotLocated:
    """As `localize_image`, with the landmarks that the photograph shows."""
    frame = photograph.frame
    known = match_landmarks(photograph.features, principal_point(frame), landmarks, config.neighbours)
    judged = QueryContext(known, frame.width, frame.height, landmarks.noise_px, landmarks.unit, config.posing)
    assumed = pose_refinement.assume_lenses(landmarks.lenses, frame.width, frame.height, frame.intrinsics)
    case = _find_best_hypothesis(judged, assumed)
    refusal = verification.run_checks(case, config.checks)
    may_be_stretched = case.source is LensSource.FREE if refusal is None else refusal.code in _OF_STRETCHED
    if may_be_stretched:
        stretched = choose_hypothesis(
            judged, search_cameras(judged, (), pose_refinement.make_non_square_lenses(judged.side)), assumed
        )
        if len(stretched.inliers) > _MORE_STRETCHED * len(case.inliers):
            case, refusal = stretched, verification.run_checks(stretched, config.checks)
    if refusal is not None:
        return refusal
    if len(case.inliers) < _AMPLE_GUIDED:
        case = match_guided(case, photograph, landmarks, assumed, config)
        refusal = verification.run_pose_checks(case, config.checks)
    return refusal or make_localization(case, photograph, landmarks, config)


def match_guided(
    case: PoseHypothesis,
    photograph: QueryImage,
    landmarks: Landmarks,
    assumed: Sequence[LensAssumption],
    config: LocalizationConfig,
) -> PoseHypothesis:
    """The case with more points: each landmark is looked for again near to where the camera that was found sees it.

    As it is where chance would be too much of these. Whether the camera was found at all the first points tell.
    """
    assert case.posed is not None
    by, camera, principal = case.by, case.posed.fit.camera, principal_point(photograph.frame)
    near = PosePrior(camera, (by.width, by.height), REACH * by.side, case.posed.fit.covariance)
    judged = replace(by, known=match_landmarks(photograph.features, principal, landmarks, config.neighbours, near))
    chosen = choose_lens(judged, [camera], assumed)
    count = 0 if chosen is None else int(chosen.posed.agreeing.sum())
    by_chance = (by.settings.max_error_px * by.scale / (REACH * by.side)) ** 2 * (len(judged.known) - count)
    if chosen is None or count <= len(case.inliers) or by_chance > _MAX_GUIDED_BY_CHANCE * count:
        return case
    return PoseHypothesis(judged, chosen.posed, case.log10_nfa, chosen.source)


def make_localization(
    case: PoseHypothesis, photograph: QueryImage, landmarks: Landmarks, config: LocalizationConfig
) -> Localization | NotLocated:
    """The camera of the photograph, which no check refuses, with what is claimed of it; a refusal where it is mirrored.

    The last check is here, since it compares all features once more. A shear of the image, as by a rolling shutter
    while the camera turns, is taken out: the camera, and what is claimed of it, are those of the image without it.
    """
    assert case.posed is not None  # a check refuses it
    frame, mirror = photograph.frame, config.checks.mirror
    shear = verification.measure_shear(case.by, case.posed.fit.camera)
    straight = verification.straighten(case, shear) if abs(shear) > config.checks.least_shear else None
    case, shear = (case, 0.0) if straight is None else (straight, shear)
    assert case.posed is not None
    if frame.intrinsics is not None:
        refusal = verification.check_stated_focal(case.posed.fit.camera.lens, frame.intrinsics.fx, config.checks)
        if refusal is not None:
            return refusal
    refusal = verification.check_mirrored(measure_mirror_gain(photograph.features, landmarks, mirror), config.checks)
    if refusal is not None:
        return refusal
    claim, covariance = verification.compute_error_bounds(
        case.posed, case.correspondences, landmarks, max(frame.width, frame.height)
    )
    refusal = verification.check_uncertainty(claim, config.checks)
    if refusal is not None:
        return refusal
    camera = case.posed.fit.camera
    K = np.diag([*camera.lens.focals, 1.0])
    K[:2, 2] = principal_point(frame) + camera.lens.shift
    count, metric = int(case.posed.agreeing.sum()), landmarks.metric
    at = Located(camera.T_world_camera, K, covariance, claim, count, metric, case.source, camera.lens.radial, shear)
    apart = compute_rms_radius(landmarks.Ts_world_camera[:, :3, 3])
    return Localization(at, camera, case.inliers, (frame.width, frame.height), apart)


def _find_best_hypothesis(judged: QueryContext, assumed: Sequence[LensAssumption]) -> PoseHypothesis:
    """The best camera: quickly, and where too little agrees with it for a sure answer, by a longer search."""
    others = pose_refinement.make_lens_grid(judged.side, assumed)
    best = choose_hypothesis(judged, search_cameras(judged, assumed, others), assumed)
    if best.log10_nfa < _AMPLE_NFA and len(best.inliers) >= _AMPLE_POINTS:
        return best
    longer = choose_hypothesis(judged, search_cameras_longer(judged, others), assumed)
    return min(best, longer, key=lambda each: each.log10_nfa)


def choose_hypothesis(
    judged: QueryContext, cameras: Sequence[CameraModel], assumed: Sequence[LensAssumption]
) -> PoseHypothesis:
    """The case of the best of the `cameras`, with the lens that its points leave to it."""
    chosen = choose_lens(judged, cameras, assumed)
    return (
        judged.make_hypothesis(None)
        if chosen is None
        else judged.make_hypothesis(chosen.posed, chosen.source, chosen.rivals)
    )


# A photograph whose camera is nearly known, as that of one that follows another: found in a fraction of the time.


# Fewer features, of a smaller picture: it is seen from nearly the same place.
QUICK = LocalizationConfig(
    features=matching_features.FeatureConfig(max_num_features=3000, min_longer_side=800, max_image_size=1000),
    posing=pose_refinement.PoseSearchConfig(iterations=2_000, rounds=2),
)
_STRONGEST = 1500  # features by which the camera is found at first


def follow(
    landmarks: Landmarks,
    image: npt.NDArray[np.uint8],  # (H, W, 3) RGB
    near: Located | Array,
    intrinsics: Intrinsics | None = None,
    config: LocalizationConfig = LocalizationConfig(),  # noqa: B008 (it is frozen)
) -> Located | NotLocated:
    """As `locate`, for an image that was taken near to another one, or near to a pose T_world_camera (4, 4).

    Of another one, `near` is what was found of it; it is of the size and the lens of this one. Landmarks are looked for
    where that camera would see them, and the image is judged as any other; where that refuses it, it is looked for as
    if nothing were known.
    """
    photograph = prepare_query_image(image, intrinsics, QUICK)
    found = localize_near(landmarks, photograph, near)
    return found.located if isinstance(found, Localization) else localize_image(landmarks, image, intrinsics, config)


def localize_near(
    landmarks: Landmarks,
    photograph: QueryImage,
    near: Located | Array,
    config: LocalizationConfig = QUICK,
) -> Localization | NotLocated | None:
    """As `follow`, near to that camera alone. None where no camera is found, or its lens is not what was assumed.

    First the strongest features are compared with the landmarks that the camera sees, and what is found is judged as
    any photograph. Then all features are compared with the landmarks where the camera that was found sees them.
    """
    frame, all_features = photograph.frame, photograph.features
    principal, size, side = principal_point(frame), (frame.width, frame.height), longer_side(frame)
    assumed = _assume_lenses(near, landmarks, frame)
    if not assumed:
        return None
    T_world_camera = near.T_world_camera if isinstance(near, Located) else near
    rotation = T_world_camera[:3, :3].T
    rough = PosePrior(CameraModel(rotation, -rotation @ T_world_camera[:3, 3], assumed[0].lens), size)
    known = match_landmarks(_select_strongest(all_features), principal, landmarks, config.neighbours, rough)
    judged = QueryContext(known, *size, landmarks.noise_px, landmarks.unit, config.posing)
    chosen = choose_lens(
        judged, search_cameras(judged, assumed, pose_refinement.make_lens_grid(side, assumed)), assumed
    )
    if chosen is None or not chosen.as_assumed:
        return None
    first = judged.make_hypothesis(chosen.posed, chosen.source)
    if verification.run_presence_checks(first, config.checks) is not None:
        return None
    refined = PosePrior(chosen.posed.fit.camera, size, REACH * side, chosen.posed.fit.covariance)
    known = match_landmarks(all_features, principal, landmarks, config.neighbours, refined)
    judged = replace(judged, known=known)
    chosen = choose_lens(judged, [chosen.posed.fit.camera], assumed)
    if chosen is None or not chosen.as_assumed or chosen.posed.agreeing.sum() < len(first.inliers):
        return None
    case = PoseHypothesis(judged, chosen.posed, first.log10_nfa, chosen.source, chosen.rivals)
    return verification.run_pose_checks(case, config.checks) or make_localization(case, photograph, landmarks, config)


def _select_strongest(found: Features) -> Features:
    """Selects the strongest of plain features, which have one descriptor each."""
    few = slice(_STRONGEST)
    return Features(found.points[few], found.descriptors[few], found.point_of[few], found.tilt[few])


def _assume_lenses(near: Located | Array, landmarks: Landmarks, frame: Frame) -> list[LensAssumption]:
    """Returns the lenses to assume: the given one, that of the image before, or what any image may have."""
    assumed = pose_refinement.assume_lenses(landmarks.lenses, frame.width, frame.height, frame.intrinsics)
    if not isinstance(near, Located) or (assumed and assumed[0].exact):
        return assumed
    return [pose_refinement.carry_over(near, principal_point(frame), longer_side(frame))]


# The photographs that a command line names, and what it says of their lens.


def stream_query_frames(paths: Sequence[Path], given: Intrinsics | None) -> Iterator[Frame | DroppedFrame]:
    """The photographs that the paths name, each a file or a folder, in their order.

    `given` is the lens of those that have its aspect ratio. Raises FileNotFoundError for a path that is not there.
    """
    for frame in _stream_paths(paths):
        yield frame if given is None else assign_lens(frame, given)


def check_lens(given: Intrinsics, frames: Iterable[Frame | DroppedFrame]) -> None:
    """Looks for a photograph that the lens can be of, and takes no more frames than that needs.

    Raises ValueError where there are photographs and it is of none, or where its distortion cannot be undone.
    """
    others: set[tuple[int, int]] = set()
    for frame in frames:
        if isinstance(frame, Frame) and same_aspect(given, frame.width, frame.height):
            undistort_frame(replace(frame, intrinsics=given, right=None))
            return
        if isinstance(frame, Frame):
            others.add((frame.width, frame.height))
    check_fits(given, others)


def _stream_paths(paths: Sequence[Path]) -> Iterator[Frame | DroppedFrame]:
    for path in paths:
        if path.is_dir():
            yield from folder.stream(folder.Config(folder=path))
        elif path.is_file():
            for name in folder.name_photographs([path]):
                yield from folder.stream(folder.Config(folder=path.parent, names=(name,)))
        else:
            raise FileNotFoundError(f"{str(path)!r} is not there; give photographs, or folders that hold some")


def choose_intrinsics(frame: Frame, fov_deg: float | None) -> Intrinsics | None:
    """Returns the image's intrinsics; an angle of view, across the longer side, holds to a few per cent."""
    if fov_deg is None:
        return frame.intrinsics
    focal = max(frame.width, frame.height) / 2.0 / math.tan(math.radians(fov_deg) / 2.0)
    middle = frame.width / 2.0, frame.height / 2.0
    return Intrinsics(frame.width, frame.height, focal, focal, *middle, source="exif")


# The verb locate: where further photographs were taken, in a result that was saved.

EXIT_GOOD, EXIT_REFUSED = 0, 65


def locate(args: argparse.Namespace) -> int:
    """A line a photograph; EXIT_GOOD where all were placed."""
    landmarks = read_landmarks(args.result)
    given = None if args.intrinsics is None else read_lens(args.intrinsics)
    if given is not None:
        check_lens(given, stream_query_frames(args.images, None))
    records, refused, of_other_lens = [], 0, 0
    for frame in stream_query_frames(args.images, given):
        found = frame if isinstance(frame, DroppedFrame) else _localize_frame(landmarks, frame, args.fov)
        say(f"{frame.name}: {f'left out: {found.reason}' if isinstance(found, DroppedFrame) else found.sentence}")
        records.append({"name": frame.name, **_record(found, frame)})
        refused += not isinstance(found, Located)
        if given is not None and isinstance(frame, Frame):
            of_other_lens += not same_aspect(given, frame.width, frame.height)
    if of_other_lens:
        say(f"the lens was not given to {of_other_lens} of them, which have another aspect ratio than its images")
    say(f"{len(records) - refused} of {len(records)} photographs were placed in {args.result}")
    if args.json is not None:
        world = replace(StoredResult.create_from_path(args.result).scale(), metric=landmarks.metric)
        fields = {"result": str(args.result), "unit": world.unit, "scale": world.word, "frame": None}  # nobody tells it
        fields |= world.frame.record() if (args.result / "cameras.json").is_file() else {}
        write_file(args.json, json_bytes({**fields, "photographs": records}))
        say(f"results: {args.json}")
    return EXIT_REFUSED if refused else EXIT_GOOD


def _localize_frame(landmarks: Landmarks, frame: Frame, fov_deg: float | None) -> Located | NotLocated | DroppedFrame:
    """Localizes a frame; drops one whose lens cannot be undistorted, which costs no other image."""
    try:
        photograph = prepare_query_image(frame.image, choose_intrinsics(frame, fov_deg), name=frame.name)
    except ValueError as error:
        return DroppedFrame(frame.name, str(error).removeprefix(f"{frame.name}: "))
    return localize_query(landmarks, photograph)


def _record(found: Located | NotLocated | DroppedFrame, frame: Frame | DroppedFrame) -> dict[str, object]:
    if isinstance(found, DroppedFrame):
        return {"placed": False, "code": "UNREADABLE", "message": found.reason}
    if isinstance(found, NotLocated):
        return {"placed": False, "code": found.code.value, "message": found.message, "advice": found.advice}
    assert isinstance(frame, Frame)  # it was located
    arrays = {name: getattr(found, name).tolist() for name in ("T_world_camera", "K", "covariance")}
    size = {"width": frame.width, "height": frame.height}
    lens = {"lens": found.lens.value, "distortion": list(found.distortion), "shear": found.shear}
    return {"placed": True, **arrays, **size, **lens, "claim": asdict(found.claim), "points": found.num_points}
