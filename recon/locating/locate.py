"""Where in a finished scene a photograph was taken that was not in the set, or why that cannot be said.

Its features are matched with the scene's landmarks, a pose is found on which most of them agree, and everything that
speaks against it is asked (checks.py): being wrong is worse than refusing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses.undistort import undistorted
from splatnode.recon.frames.keyframe import Features, longer_side, principal_point
from splatnode.recon.geometry import spread
from splatnode.recon.locating import candidates, checks, claims, posing
from splatnode.recon.locating.camera_model import CameraModel, Lens
from splatnode.recon.locating.case import Case, Judged
from splatnode.recon.locating.correspondences import Correspondences, correspondences
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.locating.refinement import Fit, refined
from splatnode.recon.matching import features, nearest_neighbours
from splatnode.recon.result.landmarks import Landmarks

Array = npt.NDArray[np.float64]

# A lens is what it was taken for where, once it is free, it moves by no more than so many standard deviations, or so
# much: of the logarithm of the focal length, and of the longer side for the principal point.
_SAME_LENS_SIGMAS, _SAME_LENS_LOG, _SAME_LENS_SHIFT = 3.0, 0.02, 0.012
_AMPLE_NFA = -30.0  # log10: so surely is no pose of another lens needed


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
    case = _case(known, frame, landmarks, config)
    return checks.refused(case, config.checks) or claimed(case, frame, landmarks, config)


def claimed(case: Case, frame: Frame, landmarks: Landmarks, config: Config) -> Placed | NotLocated:
    """The camera of the photograph `frame` that no check refuses, with what is claimed of it."""
    assert case.posed is not None  # a check refuses it
    claim, covariance = claims.claimed(case.posed, case.known, landmarks)
    refusal = checks.too_rough(claim, config.checks)
    if refusal is not None:
        return refusal
    camera = case.posed.fit.camera
    K = np.diag([camera.lens.focal, camera.lens.focal, 1.0])
    K[:2, 2] = principal_point(frame) + camera.lens.shift
    at = Located(camera.T_world_camera, K, covariance, claim, int(case.posed.agreeing.sum()), landmarks.metric)
    apart = spread(landmarks.Ts_world_camera[:, :3, 3])
    return Placed(at, camera, case.agreeing, (frame.width, frame.height), apart)


def _case(known: Correspondences, frame: Frame, landmarks: Landmarks, config: Config) -> Case:
    """The best camera, of the likeliest lens that explains enough."""
    side, given = longer_side(frame), frame.intrinsics
    judged = Judged(known, frame.width, frame.height, landmarks.noise_px, landmarks.unit, config.posing)
    certain = None if given is None else candidates.given(given)
    if certain is not None:
        return judged.case(judged.posed(certain))
    best = judged.case(None)
    for lens in candidates.own(landmarks.lenses, frame.width, frame.height, given):
        found = judged.case(judged.posed(lens))
        if found.log10_nfa < best.log10_nfa and as_uncropped(found, judged, side) is found:
            best = found
    if best.log10_nfa < _AMPLE_NFA:
        return best
    others = candidates.any_lens(side) if given is None else [candidates.nominal(given, side)]
    found = judged.case(judged.posed(*others))
    return min(best, as_uncropped(found, judged, side), key=lambda each: each.log10_nfa)


def as_uncropped(found: Case, judged: Judged, side: int) -> Case:
    """The case as it is; or, where its lens does not stay what it is once it is free, with a free lens.

    Such a picture is of another lens, or a part of what its camera saw.
    """
    if found.posed is None:
        return found
    again = judged.settled(found.posed.fit.camera, candidates.cropped(found.posed.fit.camera.lens, side))
    return found if again is None or _same_lens(found.posed.prior, again.fit, side) else judged.case(again)


def of_its_lens(case: Case, side: int) -> bool:
    """Whether the lens stays what it was taken for once it is free, by what agrees with the camera."""
    assert case.posed is not None
    camera, by = case.posed.fit.camera, case.by
    free = refined(camera, candidates.cropped(camera.lens, side), case.agreeing, by.noise_px)
    return _same_lens(case.posed.prior, free, side)


def _same_lens(prior: Lens, fit: Fit, side: int) -> bool:
    free, sigmas = fit.camera.lens, _SAME_LENS_SIGMAS * np.sqrt(np.diag(fit.covariance)[6:])
    of_focal = abs(math.log(free.focal / prior.focal)) / max(
        _SAME_LENS_LOG, _SAME_LENS_SIGMAS * prior.log_focal_sigma, sigmas[0]
    )
    of_shift = np.abs(free.shift - prior.shift) / np.maximum(_SAME_LENS_SHIFT * side, sigmas[2:])
    return bool(max(of_focal, *of_shift) < 1.0)
