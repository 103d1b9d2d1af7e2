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
from splatnode.capture.lenses.undistort import undistorted
from splatnode.recon.frames.keyframe import Features, principal_point
from splatnode.recon.geometry import spread
from splatnode.recon.locating import candidates, checks, claims, posing
from splatnode.recon.locating.camera_model import CameraModel
from splatnode.recon.locating.candidates import Assumed
from splatnode.recon.locating.case import Case, Judged
from splatnode.recon.locating.correspondences import Correspondences, Near, correspondences, measure_mirror_gain
from splatnode.recon.locating.lens_choice import choose_lens, search, search_longer
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


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    features: features.Config = features.Config()
    neighbours: nearest_neighbours.Config = nearest_neighbours.Config()
    posing: posing.Config = posing.Config()
    checks: checks.Config = checks.Config()


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph without distortion, with its features."""

    frame: Frame
    features: Features


@dataclass(frozen=True, eq=False)
class Placed:
    """A photograph that was placed, with what placed it."""

    located: Located
    camera: CameraModel
    seen: Correspondences  # what agrees with the camera: each landmark, and each of the photograph's features, once
    size: tuple[int, int]  # (width, height) of the photograph, pixels
    spread: float  # RMS distance of the scene's cameras from their middle, in the unit of the result


def locate(
    landmarks: Landmarks,
    image: npt.NDArray[np.uint8],  # (H, W, 3) RGB
    intrinsics: Intrinsics | None = None,
    config: Config = Config(),  # noqa: B008 (it is frozen)
) -> Located | NotLocated:
    """The camera of `image` in the world of the landmarks, with what is claimed of it; else why there is none.

    `intrinsics` are those of the image, if they are known; a lens with distortion needs them, and the camera is that of
    the image without it. Without them the lenses of the scene's own photographs are tried first, then any. Raises
    ValueError for an image that is not (H, W, 3) uint8, or intrinsics that cannot be used.
    """
    return located(landmarks, described(image, intrinsics, config), config)


def described(
    image: npt.NDArray[np.uint8],
    intrinsics: Intrinsics | None = None,
    config: Config = Config(),  # noqa: B008
    name: str = "photograph",
) -> Photograph:
    """What `located` needs of a photograph, which may be looked for in several scenes. As `locate` otherwise.

    `name` is what the sentence of a ValueError calls the photograph.
    """
    frame = undistorted(Frame(0, name, 0, image, intrinsics))
    return Photograph(frame, features.extract(frame.image, config.features))


def located(landmarks: Landmarks, photograph: Photograph, config: Config = Config()) -> Located | NotLocated:  # noqa: B008
    """As `locate`."""
    found = placed(landmarks, photograph, config)
    return found.located if isinstance(found, Placed) else found


def placed(landmarks: Landmarks, photograph: Photograph, config: Config = Config()) -> Placed | NotLocated:  # noqa: B008
    """As `locate`, with the landmarks that the photograph shows."""
    frame = photograph.frame
    known = correspondences(photograph.features, principal_point(frame), landmarks, config.neighbours)
    judged = Judged(known, frame.width, frame.height, landmarks.noise_px, landmarks.unit, config.posing)
    assumed = candidates.assume(landmarks.lenses, frame.width, frame.height, frame.intrinsics)
    case = _case(judged, assumed)
    refusal = checks.refused(case, config.checks)
    if refusal is not None and refusal.code in _OF_STRETCHED:
        stretched = case_of(judged, search(judged, (), candidates.stretched_lenses(judged.side)), assumed)
        if len(stretched.agreeing) > _MORE_STRETCHED * len(case.agreeing):
            case, refusal = stretched, checks.refused(stretched, config.checks)
    if refusal is not None:
        return refusal
    if len(case.agreeing) < _AMPLE_GUIDED:
        case = guide(case, photograph, landmarks, assumed, config)
        refusal = checks.refused_as_wrong(case, config.checks)
    return refusal or claimed(case, photograph, landmarks, config)


def guide(case: Case, photograph: Photograph, landmarks: Landmarks, assumed: Sequence[Assumed], config: Config) -> Case:
    """The case with more points: each landmark is looked for again near to where the camera that was found sees it.

    As it is where chance would be too much of these. Whether the camera was found at all the first points tell.
    """
    assert case.posed is not None
    by, camera, principal = case.by, case.posed.fit.camera, principal_point(photograph.frame)
    near = Near(camera, (by.width, by.height), REACH * by.side)
    judged = replace(by, known=correspondences(photograph.features, principal, landmarks, config.neighbours, near))
    chosen = choose_lens(judged, [camera], assumed)
    count = 0 if chosen is None else int(chosen.posed.agreeing.sum())
    by_chance = (by.settings.max_error_px * by.scale / (REACH * by.side)) ** 2 * (len(judged.known) - count)
    if chosen is None or count <= len(case.agreeing) or by_chance > _MAX_GUIDED_BY_CHANCE * count:
        return case
    return Case(judged, chosen.posed, case.log10_nfa, chosen.source)


def claimed(case: Case, photograph: Photograph, landmarks: Landmarks, config: Config) -> Placed | NotLocated:
    """The camera of the photograph, which no check refuses, with what is claimed of it; a refusal where it is mirrored.

    The last check is here, since it compares all features once more.
    """
    assert case.posed is not None  # a check refuses it
    frame, mirror = photograph.frame, config.checks.mirror
    if frame.intrinsics is not None:
        refusal = checks.contradicts_statement(case.posed.fit.camera.lens, frame.intrinsics.fx, config.checks)
        if refusal is not None:
            return refusal
    refusal = checks.mirrored(measure_mirror_gain(photograph.features, landmarks, mirror), config.checks)
    if refusal is not None:
        return refusal
    claim, covariance = claims.claimed(case.posed, case.known, landmarks, max(frame.width, frame.height))
    refusal = checks.too_rough(claim, config.checks)
    if refusal is not None:
        return refusal
    camera = case.posed.fit.camera
    K = np.diag([*camera.lens.focals, 1.0])
    K[:2, 2] = principal_point(frame) + camera.lens.shift
    count, metric = int(case.posed.agreeing.sum()), landmarks.metric
    at = Located(camera.T_world_camera, K, covariance, claim, count, metric, case.source, camera.lens.radial)
    apart = spread(landmarks.Ts_world_camera[:, :3, 3])
    return Placed(at, camera, case.agreeing, (frame.width, frame.height), apart)


def _case(judged: Judged, assumed: Sequence[Assumed]) -> Case:
    """The best camera: quickly, and where too little agrees with it for a sure answer, by a longer search."""
    others = candidates.any_lens(judged.side, assumed)
    best = case_of(judged, search(judged, assumed, others), assumed)
    if best.log10_nfa < _AMPLE_NFA and len(best.agreeing) >= _AMPLE_POINTS:
        return best
    longer = case_of(judged, search_longer(judged, others), assumed)
    return min(best, longer, key=lambda each: each.log10_nfa)


def case_of(judged: Judged, cameras: Sequence[CameraModel], assumed: Sequence[Assumed]) -> Case:
    """The case of the best of the `cameras`, with the lens that its points leave to it."""
    chosen = choose_lens(judged, cameras, assumed)
    return judged.case(None) if chosen is None else judged.case(chosen.posed, chosen.source, chosen.rivals)
