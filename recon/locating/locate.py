"""Where in a finished scene a photograph was taken that was not in the set, or why that cannot be said.

Its features are matched with the scene's landmarks, a pose is found on which most of them agree, and everything that
speaks against it is asked (checks.py): being wrong is worse than refusing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses.undistort import undistort_frame
from splatnode.recon.frames.keyframe import Features, principal_point
from splatnode.recon.geometry import compute_rms_radius
from splatnode.recon.locating import candidates, checks, claims, posing
from splatnode.recon.locating.camera_model import CameraModel
from splatnode.recon.locating.candidates import LensAssumption
from splatnode.recon.locating.case import PoseHypothesis, QueryContext
from splatnode.recon.locating.correspondences import Correspondences, PosePrior, match_landmarks, measure_mirror_gain
from splatnode.recon.locating.lens_choice import choose_lens, search_cameras, search_cameras_longer
from splatnode.recon.locating.outcome import Located, NotLocated, Reason
from splatnode.recon.matching import features, nearest_neighbours
from splatnode.recon.result.landmarks import Landmarks

Array = npt.NDArray[np.float64]

_AMPLE_GUIDED = 300  # points that agree: with fewer, landmarks are looked for again
_MAX_GUIDED_BY_CHANCE = 0.1  # of what agrees then
REACH = 0.02  # of the longer side: how far from where a camera sees it a landmark is looked for
_AMPLE_NFA, _AMPLE_POINTS = -30.0, 100  # log10, and points that agree: so surely is no longer search needed

# What the parts of an image say whose pixels are not square; then so many times as many points must agree.
_OF_STRETCHED, _MORE_STRETCHED = (Reason.ELSEWHERE, Reason.INCONSISTENT), 1.25


class LocalizationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    features: features.FeatureConfig = features.FeatureConfig()
    neighbours: nearest_neighbours.NearestNeighbourConfig = nearest_neighbours.NearestNeighbourConfig()
    posing: posing.PoseSearchConfig = posing.PoseSearchConfig()
    checks: checks.LocalizationCheckConfig = checks.LocalizationCheckConfig()


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
    return QueryImage(frame, features.extract(frame.image, config.features))


def localize_query(
    landmarks: Landmarks, photograph: QueryImage, config: LocalizationConfig = LocalizationConfig()
) -> Located | NotLocated:  # noqa: B008
    """As `localize_image`."""
    found = localize_with_inliers(landmarks, photograph, config)
    return found.located if isinstance(found, Localization) else found


def localize_with_inliers(
    landmarks: Landmarks, photograph: QueryImage, config: LocalizationConfig = LocalizationConfig()
) -> Localization | NotLocated:  # noqa: B008
    """As `localize_image`, with the landmarks that the photograph shows."""
    frame = photograph.frame
    known = match_landmarks(photograph.features, principal_point(frame), landmarks, config.neighbours)
    judged = QueryContext(known, frame.width, frame.height, landmarks.noise_px, landmarks.unit, config.posing)
    assumed = candidates.assume_lenses(landmarks.lenses, frame.width, frame.height, frame.intrinsics)
    case = _find_best_hypothesis(judged, assumed)
    refusal = checks.run_checks(case, config.checks)
    if refusal is not None and refusal.code in _OF_STRETCHED:
        stretched = choose_hypothesis(
            judged, search_cameras(judged, (), candidates.make_non_square_lenses(judged.side)), assumed
        )
        if len(stretched.inliers) > _MORE_STRETCHED * len(case.inliers):
            case, refusal = stretched, checks.run_checks(stretched, config.checks)
    if refusal is not None:
        return refusal
    if len(case.inliers) < _AMPLE_GUIDED:
        case = match_guided(case, photograph, landmarks, assumed, config)
        refusal = checks.run_pose_checks(case, config.checks)
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
        refusal = checks.check_stated_focal(case.posed.fit.camera.lens, frame.intrinsics.fx, config.checks)
        if refusal is not None:
            return refusal
    refusal = checks.check_mirrored(measure_mirror_gain(photograph.features, landmarks, mirror), config.checks)
    if refusal is not None:
        return refusal
    claim, covariance = claims.compute_error_bounds(
        case.posed, case.correspondences, landmarks, max(frame.width, frame.height)
    )
    refusal = checks.check_uncertainty(claim, config.checks)
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
    others = candidates.make_lens_grid(judged.side, assumed)
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
