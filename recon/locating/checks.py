"""What speaks against the camera that was found for a photograph. Each check refuses by the evidence of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from splatnode.recon.locating import posing
from splatnode.recon.locating.camera_model import CameraModel
from splatnode.recon.locating.case import Case
from splatnode.recon.locating.outcome import Claim, NotLocated, Reason
from splatnode.recon.locating.refinement import pose_covariance, refined

Array = npt.NDArray[np.float64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_log10_nfa: float = -12.0  # as of a pair of photographs (recon/matching/two_view.py)
    min_points: int = 15  # that agree, as of a view that is added to a map (recon/registration/resection.py)
    min_share_of_picture: float = 0.04  # that their hull covers: less may be a thing that stood elsewhere
    max_elsewhere: float = 0.5  # agreement with a second camera, over that with the first
    max_apart: float = 4.0  # standard deviations between what two halves of the picture say of the camera
    focal_range: tuple[float, float] = (0.3, 6.0)  # over the longer side: 118 to 10 degrees of view
    max_shift: float = 0.5  # of the principal point, over the longer side: it is in the picture, or was before a crop
    max_rotation_deg: float = 5.0  # of the claim; beyond, a camera is far off (recon/evaluate/stability/claim.py)
    max_centre_percent: float = 10.0  # likewise


Check = Callable[[Case, Config], NotLocated | None]


def refused(case: Case, config: Config) -> NotLocated | None:
    """The first check that refuses, or None."""
    return _first(case, config, _CHECKS)


def refused_as_chance(case: Case, config: Config) -> NotLocated | None:
    """The same of the checks whether the camera was found at all, which matches with all that is in view answer."""
    return _first(case, config, _WHETHER_FOUND)


def refused_as_wrong(case: Case, config: Config) -> NotLocated | None:
    """The same of the other ones."""
    return _first(case, config, [check for check in _CHECKS if check not in _WHETHER_FOUND])


def _first(case: Case, config: Config, checks: Sequence[Check]) -> NotLocated | None:
    if case.posed is None:
        return nothing_found(case)
    return next((found for check in checks if (found := check(case, config)) is not None), None)


def nothing_found(case: Case) -> NotLocated:
    """Where chance explains what agrees."""
    count = len(case.agreeing)
    agree = f"only {count} points agree with one camera, as chance may give" if count else "no points agree"
    return NotLocated(
        Reason.NOT_FOUND,
        f"too little of it is in the scene: {agree}.",
        "Take it nearer to where the scene's photographs were taken, looking the same way.",
    )


def too_rough(claim: Claim, config: Config) -> NotLocated | None:
    """Where the camera is known too roughly to be of use."""
    if claim.rotation_deg <= config.max_rotation_deg and claim.centre_percent <= config.max_centre_percent:
        return None
    return NotLocated(
        Reason.UNCERTAIN,
        f"its camera is known to {claim.rotation_deg:.0f} degrees and {claim.centre_percent:.0f} % of the distance "
        f"only; at most {config.max_rotation_deg:g} degrees and {config.max_centre_percent:g} % are given out.",
        "Take it so that more of the scene is in it, or give its calibration.",
    )


def _by_chance(case: Case, config: Config) -> NotLocated | None:
    enough = case.num_independent >= config.min_points and case.log10_nfa <= config.max_log10_nfa
    return None if enough else nothing_found(case)


def _in_one_patch(case: Case, config: Config) -> NotLocated | None:
    share = _hull_area(case.agreeing.pixels) / (case.by.width * case.by.height)
    if share >= config.min_share_of_picture:
        return None
    return NotLocated(
        Reason.ONE_PATCH,
        f"all that agrees with the scene lies in {100 * share:.1f} % of the picture, which may be one thing that "
        "stood elsewhere.",
        "Take it so that more of the scene is in it.",
    )


def _hull_area(pixels: Array) -> float:
    try:
        return float(ConvexHull(pixels).volume)  # of a hull in the plane, its area
    except (QhullError, ValueError):
        return 0.0


def _with_an_impossible_lens(case: Case, config: Config) -> NotLocated | None:
    assert case.posed is not None
    lens, side = case.posed.fit.camera.lens, max(case.by.width, case.by.height)
    least, most = config.focal_range
    shift = float(np.linalg.norm(lens.shift)) / side
    if least <= lens.focal / side <= most and shift <= config.max_shift:
        return None
    return NotLocated(
        Reason.LENS,
        f"it would take a focal length of {lens.focal / side:.2g} times the longer side, and a lens that looks "
        f"{100 * shift:.0f} % of it beside the middle.",
        "Give the photograph as the camera made it, not cropped, or its calibration.",
    )


def _as_well_elsewhere(case: Case, config: Config) -> NotLocated | None:
    """Whether what disagrees with the camera agrees with another one."""
    assert case.posed is not None
    fit = case.posed.fit
    explained = np.isin(case.known.feature_of, case.agreeing.feature_of)
    lens = fit.camera.lens
    start = posing.searched(case.known.of(~explained), lens, case.by.scale, case.by.settings)
    found = start and case.by.settled(start, lens)
    if found is None or _near(fit.camera, found.fit.camera, case.by.unit):
        return None
    count = int(found.agreeing.sum())
    if count <= max(config.max_elsewhere * len(case.agreeing), config.min_points):
        return None
    return NotLocated(
        Reason.ELSEWHERE,
        f"{len(case.agreeing)} points agree with one camera and {count} with another one: the scene repeats itself.",
        "Take it so that something is in it which the scene has once.",
    )


_NEAR_DEG, _NEAR_SHARE = 5.0, 0.1  # two cameras nearer than this, of the distance to the scene, are one


def _near(one: CameraModel, other: CameraModel, unit: float) -> bool:
    turn = np.degrees(Rotation.from_matrix(one.rotation @ other.rotation.T).magnitude())
    apart = np.linalg.norm(one.T_world_camera[:3, 3] - other.T_world_camera[:3, 3])
    return bool(turn < _NEAR_DEG and apart < _NEAR_SHARE * unit)


def _halves_disagree(case: Case, config: Config) -> NotLocated | None:
    """Whether the halves of the picture say different things of the camera, beyond what they leave open."""
    assert case.posed is not None
    fit, agreeing = case.posed.fit, case.agreeing
    farthest = 0.0
    for axis in (0, 1):
        first = agreeing.pixels[:, axis] < np.median(agreeing.pixels[:, axis])
        halves = [refined(fit.camera, fit.camera.lens, agreeing.of(half), case.by.noise_px) for half in (first, ~first)]
        T1, T2 = (half.camera.T_world_camera for half in halves)
        between = np.linalg.inv(T1) @ T2
        turn = np.array([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]])
        apart = np.concatenate([between[:3, 3], turn / 2.0])
        covariance = sum(pose_covariance(half.camera, half.covariance) for half in halves)
        known = np.isfinite(covariance).all()  # what is not known fails
        squared = float(apart @ np.linalg.pinv(covariance, hermitian=True) @ apart) if known else math.inf
        farthest = max(farthest, math.sqrt(max(squared, 0.0) / 6.0))
    if farthest <= config.max_apart:
        return None
    return NotLocated(
        Reason.INCONSISTENT,
        "two halves of it put the camera in different places, farther apart than their uncertainty allows.",
        "Something has moved, or its lens bends straight lines: give its calibration.",
    )


_CHECKS: tuple[Check, ...] = (
    _by_chance,
    _with_an_impossible_lens,
    _in_one_patch,
    _as_well_elsewhere,
    _halves_disagree,
)
_WHETHER_FOUND: tuple[Check, ...] = (_by_chance, _as_well_elsewhere)
