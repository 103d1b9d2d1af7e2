"""A photograph whose camera is nearly known, as that of one that follows another: found in a fraction of the time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.recon.frames.keyframe import Features, longer_side, principal_point
from splatnode.recon.locating import candidates, checks, posing
from splatnode.recon.locating.camera_model import CameraModel
from splatnode.recon.locating.candidates import LensAssumption
from splatnode.recon.locating.case import PoseHypothesis, QueryContext
from splatnode.recon.locating.correspondences import PosePrior, match_landmarks
from splatnode.recon.locating.lens_choice import choose_lens, search_cameras
from splatnode.recon.locating.locate import (
    REACH,
    Localization,
    LocalizationConfig,
    QueryImage,
    localize_image,
    make_localization,
    prepare_query_image,
)
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.matching import features
from splatnode.recon.result.landmarks import Landmarks

Array = npt.NDArray[np.float64]

# Fewer features, of a smaller picture: it is seen from nearly the same place.
QUICK = LocalizationConfig(
    features=features.FeatureConfig(num_features=3000, min_longer_side=800, max_longer_side=1000),
    posing=posing.PoseSearchConfig(iterations=2_000, rounds=2),
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
    chosen = choose_lens(judged, search_cameras(judged, assumed, candidates.make_lens_grid(side, assumed)), assumed)
    if chosen is None or not chosen.as_assumed:
        return None
    first = judged.make_hypothesis(chosen.posed, chosen.source)
    if checks.run_presence_checks(first, config.checks) is not None:
        return None
    exact = PosePrior(chosen.posed.fit.camera, size, REACH * side)
    known = match_landmarks(all_features, principal, landmarks, config.neighbours, exact)
    judged = replace(judged, known=known)
    chosen = choose_lens(judged, [chosen.posed.fit.camera], assumed)
    if chosen is None or not chosen.as_assumed or chosen.posed.agreeing.sum() < len(first.inliers):
        return None
    case = PoseHypothesis(judged, chosen.posed, first.log10_nfa, chosen.source, chosen.rivals)
    return checks.run_pose_checks(case, config.checks) or make_localization(case, photograph, landmarks, config)


def _select_strongest(found: Features) -> Features:
    """Selects the strongest of plain features, which have one descriptor each."""
    few = slice(_STRONGEST)
    return Features(found.points[few], found.descriptors[few], found.point_of[few], found.tilt[few])


def _assume_lenses(near: Located | Array, landmarks: Landmarks, frame: Frame) -> list[LensAssumption]:
    """Returns the lenses to assume: the given one, that of the image before, or what any image may have."""
    assumed = candidates.assume_lenses(landmarks.lenses, frame.width, frame.height, frame.intrinsics)
    if not isinstance(near, Located) or (assumed and assumed[0].exact):
        return assumed
    return [candidates.carry_over(near, principal_point(frame), longer_side(frame))]
