"""Where in a finished scene a photograph was taken that was not in the set, or why that cannot be said.

Its features are matched with the scene's landmarks, a pose is found on which most of them agree, and everything that
speaks against it is asked (verification.py): being wrong is worse than refusing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.lens_file import assign_lens, check_fits, same_aspect
from splatnode.capture.lenses import undistort_frame
from splatnode.recon.frames.keyframe import Features, longer_side, principal_point
from splatnode.recon.geometry import compute_rms_radius
from splatnode.recon.locating import pose_refinement, verification
from splatnode.recon.locating.outcome import Located, NotLocated, Reason
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
from splatnode.recon.result.snapshot import Landmarks

Array = npt.NDArray[np.float64]

_AMPLE_GUIDED = 300  # points that agree: with fewer, landmarks are looked for again
_MAX_GUIDED_BY_CHANCE = 0.1  # of what agrees then
REACH = 0.02  # of the longer side: how far from where a camera sees it a landmark is looked for
_AMPLE_NFA, _AMPLE_POINTS = -30.0, 100  # log10, and points that agree: so surely is no longer search needed

# What the parts of an image say whose pixels are not square; then so many times as many points must agree.
_OF_STRETCHED, _MORE_STRETCHED = (Reason.ELSEWHERE, Reason.INCONSISTENT), 1.25


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
    if refusal is not None and refusal.code in _OF_STRETCHED:
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
    near = PosePrior(camera, (by.width, by.height), REACH * by.side)
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

    The last check is here, since it compares all features once more.
    """
    assert case.posed is not None  # a check refuses it
    frame, mirror = photograph.frame, config.checks.mirror
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
    at = Located(camera.T_world_camera, K, covariance, claim, count, metric, case.source, camera.lens.radial)
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
    exact = PosePrior(chosen.posed.fit.camera, size, REACH * side)
    known = match_landmarks(all_features, principal, landmarks, config.neighbours, exact)
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
