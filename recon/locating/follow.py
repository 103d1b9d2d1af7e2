"""A photograph whose camera is nearly known, as that of one that follows another: found in a fraction of the time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.recon.frames.keyframe import Features, longer_side, principal_point
from splatnode.recon.locating import candidates, checks, posing
from splatnode.recon.locating.camera_model import CameraModel, Lens
from splatnode.recon.locating.case import Case, Judged
from splatnode.recon.locating.claims import NORMAL_95
from splatnode.recon.locating.correspondences import Near, correspondences
from splatnode.recon.locating.locate import Config, Photograph, Placed, claimed, described, locate, of_its_lens
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.matching import features
from splatnode.recon.result.landmarks import Landmarks

Array = npt.NDArray[np.float64]

# Fewer features, of a smaller picture: it is seen from nearly the same place.
QUICK = Config(
    features=features.Config(num_features=3000, min_longer_side=800, max_longer_side=1000),
    posing=posing.Config(iterations=2_000, rounds=2),
)
_STRONGEST = 1500  # features by which the camera is found at first
_REACH = 0.02  # of the longer side: how far from where that camera sees it a landmark is then looked for


def follow(
    landmarks: Landmarks,
    image: npt.NDArray[np.uint8],  # (H, W, 3) RGB
    near: Located | Array,
    intrinsics: Intrinsics | None = None,
    config: Config = Config(),  # noqa: B008 (it is frozen)
) -> Located | NotLocated:
    """As `locate`, for an image that was taken near to another one, or near to a pose T_world_camera (4, 4).

    Of another one, `near` is what was found of it; it is of the size and the lens of this one. Landmarks are looked for
    where that camera would see them, and the image is judged as any other; where that refuses it, it is looked for as
    if nothing were known.
    """
    photograph = described(image, intrinsics, QUICK)
    found = followed(landmarks, photograph, near)
    return found.located if isinstance(found, Placed) else locate(landmarks, image, intrinsics, config)


def followed(
    landmarks: Landmarks,
    photograph: Photograph,
    near: Located | Array,
    config: Config = QUICK,
) -> Placed | NotLocated | None:
    """As `follow`, near to that camera alone. None where nothing is known of the lens, or no camera is found.

    First the strongest features are compared with the landmarks that the camera sees, and what is found is judged as
    any photograph. Then all features are compared with the landmarks where the camera that was found sees them.
    """
    frame, all_features = photograph.frame, photograph.features
    principal, size, side = principal_point(frame), (frame.width, frame.height), longer_side(frame)
    lenses = _lenses(near, landmarks, frame)
    if not lenses:
        return None
    T_world_camera = near.T_world_camera if isinstance(near, Located) else near
    rotation = T_world_camera[:3, :3].T
    rough = Near(CameraModel(rotation, -rotation @ T_world_camera[:3, 3], lenses[0]), size)
    known = correspondences(_strongest(all_features), principal, landmarks, config.neighbours, rough)
    judged = Judged(known, *size, landmarks.noise_px, landmarks.unit, config.posing)
    first = judged.case(judged.posed(*lenses))
    if first.posed is None or checks.refused_as_chance(first, config.checks) is not None:
        return None
    exact = Near(first.posed.fit.camera, size, _REACH * side)
    known = correspondences(all_features, principal, landmarks, config.neighbours, exact)
    judged = replace(judged, known=known)
    case = Case(judged, judged.settled(first.posed.fit.camera, first.posed.prior), first.log10_nfa)
    if case.posed is None or len(case.agreeing) < len(first.agreeing):
        return None
    if lenses[0].log_focal_sigma > 0 and not of_its_lens(case, side):
        return None
    return checks.refused_as_wrong(case, config.checks) or claimed(case, frame, landmarks, config)


def _strongest(found: Features) -> Features:
    """Of plain features, which have one descriptor each."""
    few = slice(_STRONGEST)
    return Features(found.points[few], found.descriptors[few], found.point_of[few], found.tilt[few])


def _lenses(near: Located | Array, landmarks: Landmarks, frame: Frame) -> list[Lens]:
    """What the photograph may have been taken with, the likeliest first."""
    given, size = frame.intrinsics, (frame.width, frame.height)
    certain = None if given is None else candidates.given(given)
    if certain is not None:
        return [certain]
    if isinstance(near, Located):
        shift = near.K[:2, 2] - principal_point(frame)
        focal, sigma = float(near.K[0, 0]), math.log1p(near.claim.focal_percent / 100.0) / NORMAL_95
        return [candidates.continued(focal, sigma, shift, landmarks.lenses, *size)]
    own = candidates.own(landmarks.lenses, *size, given)
    return own or ([] if given is None else [candidates.nominal(given, longer_side(frame))])
