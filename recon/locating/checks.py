"""What speaks against the camera that was found for a photograph. Each check refuses by the evidence of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from splatnode.recon.locating import candidates, posing
from splatnode.recon.locating.camera_model import CameraModel, Lens
from splatnode.recon.locating.case import PoseHypothesis, QueryContext
from splatnode.recon.locating.lens_choice import search_cameras
from splatnode.recon.locating.outcome import LensSource, LocalizationBounds, NotLocated, Reason
from splatnode.recon.locating.refinement import CameraFit, optimize_camera, pose_covariance
from splatnode.recon.verification import reflection

Array = npt.NDArray[np.float64]


class LocalizationCheckConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_log10_nfa: float = -12.0  # as of a pair of photographs (recon/matching/two_view.py)
    min_points: int = 15  # that agree, as of a view that is added to a map (recon/registration/resection.py)
    min_share_of_picture: float = 0.04  # that their hull covers: less may be a thing that stood elsewhere
    max_elsewhere: float = 0.5  # agreement with a second camera, over that with the first
    max_apart: float = 4.0  # standard deviations between what two halves of the picture say of the camera
    mirror: reflection.ReflectionConfig = (
        reflection.ReflectionConfig()
    )  # of the test whether it was turned left to right
    max_mirror_gain: float = 0.05  # of matches, in logarithms, once it is turned left to right; right ones have below 0
    max_rival: float = 0.8  # agreement with a camera of another lens, over that with the first
    focal_range: tuple[float, float] = (0.3, 6.0)  # over the longer side: 118 to 10 degrees of view
    crops: tuple[float, float] = (0.6, 5.0)  # what a border, or cropping, may make of a focal length that is stated
    max_shift: float = 0.5  # of the principal point, over the longer side: it is in the picture, or was before a crop
    max_log_aspect: float = 0.7  # of the focal length across over that down: 2
    max_radial: float = 0.5  # the first coefficient of a lens that bends lines; beyond, it is a fisheye
    max_rotation_deg: float = 5.0  # of the claim; beyond, a camera is far off (recon/evaluate/stability/claim.py)
    max_centre_percent: float = 10.0  # likewise


Check = Callable[[PoseHypothesis, LocalizationCheckConfig], NotLocated | None]


def run_checks(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """The first check that refuses, or None."""
    return _first(case, config, _CHECKS)


def run_presence_checks(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """The same of the checks whether the camera was found at all, which matches with all that is in view answer."""
    return _first(case, config, _WHETHER_FOUND)


def run_pose_checks(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """The same of the other ones."""
    return _first(case, config, [check for check in _CHECKS if check not in _WHETHER_FOUND])


def _first(case: PoseHypothesis, config: LocalizationCheckConfig, checks: Sequence[Check]) -> NotLocated | None:
    if case.posed is None:
        return make_not_found(case)
    return next((found for check in checks if (found := check(case, config)) is not None), None)


def make_not_found(case: PoseHypothesis) -> NotLocated:
    """Rejects a query image whose inliers chance explains."""
    count = len(case.inliers)
    agree = f"only {count} points agree with one camera, as chance may give" if count else "no points agree"
    return NotLocated(
        Reason.NOT_FOUND,
        f"too little of it is in the scene: {agree}.",
        "Take it nearer to where the scene's photographs were taken, looking the same way.",
    )


def check_uncertainty(claim: LocalizationBounds, config: LocalizationCheckConfig) -> NotLocated | None:
    """Rejects a camera that is known too roughly to be of use."""
    if claim.rotation_deg <= config.max_rotation_deg and claim.centre_percent <= config.max_centre_percent:
        return None
    return NotLocated(
        Reason.UNCERTAIN,
        f"its camera is known to {claim.rotation_deg:.0f} degrees and {claim.centre_percent:.0f} % of the distance "
        f"only; at most {config.max_rotation_deg:g} degrees and {config.max_centre_percent:g} % are given out.",
        "Take it so that more of the scene is in it, or give its calibration.",
    )


def check_stated_focal(lens: Lens, stated_focal: float, config: LocalizationCheckConfig) -> NotLocated | None:
    """Rejects a lens that neither cropping nor a border makes of the stated focal length, in pixels."""
    least, most = config.crops
    if least <= lens.focal / stated_focal <= most:
        return None
    return NotLocated(
        Reason.LENS,
        f"its points ask for a focal length of {lens.focal:.4g} pixels, where {stated_focal:.4g} are stated.",
        "Give the lens of this image, or none.",
    )


def check_mirrored(gain: float, config: LocalizationCheckConfig) -> NotLocated | None:
    """Rejects an image that matches the scene better mirrored: `gain` of `measure_mirror_gain`."""
    if gain <= config.max_mirror_gain:
        return None
    return NotLocated(
        Reason.MIRRORED,
        f"turned left to right it has {100 * math.expm1(gain):.0f} % more matches with the scene.",
        "Give the image as the camera took it; many front cameras and web conferences mirror theirs.",
    )


def _check_chance(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    enough = case.num_independent >= config.min_points and case.log10_nfa <= config.max_log10_nfa
    return None if enough else make_not_found(case)


def _check_coverage(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    share = _hull_area(case.inliers.pixels) / (case.by.width * case.by.height)
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


def _check_lens(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    assert case.posed is not None
    lens, side = case.posed.fit.camera.lens, max(case.by.width, case.by.height)
    least, most = config.focal_range
    shift = float(np.linalg.norm(lens.shift)) / side
    usual = abs(lens.log_aspect) <= config.max_log_aspect and abs(lens.radial[0]) <= config.max_radial
    if least <= lens.focal / side <= most and shift <= config.max_shift and usual:
        return None
    return NotLocated(
        Reason.LENS,
        f"it would take a focal length of {lens.focal / side:.2g} times the longer side, a lens that looks "
        f"{100 * shift:.0f} % of it beside the middle, pixels {math.exp(lens.log_aspect):.2g} times as high as wide, "
        f"and a radial coefficient of {lens.radial[0]:.2g}.",
        "Give the photograph as the camera made it, not cropped, or its calibration.",
    )


def _check_elsewhere(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """Whether what disagrees with the camera agrees with another one.

    Of an image with a lens of its own the other one may have any lens, too: the parts of a collage have several.
    """
    assert case.posed is not None
    camera = case.posed.fit.camera
    lens, explained = camera.lens, np.isin(case.correspondences.feature_of, case.inliers.feature_of)
    rest = replace(case.by, known=case.correspondences.select(~explained))
    starts, by = [posing.search_pose(rest.known, lens, rest.scale, rest.settings)], case.by
    if case.source is LensSource.FREE:
        starts += search_cameras(rest, (), candidates.make_lens_grid(rest.side, ()))[:1]
        # A free lens could reach the points of the first camera from elsewhere.
        lens, by = candidates.free_lens(lens, rest.side), rest
    found = [posed for start in starts if start is not None and (posed := by.refine_pose(start, lens)) is not None]
    apart = [int(each.agreeing.sum()) for each in found if not _is_near(camera, each.fit.camera, case.by)]
    count = max(apart, default=0)
    if count <= max(config.max_elsewhere * len(case.inliers), config.min_points):
        return None
    return _make_elsewhere(case, count)


def _make_elsewhere(case: PoseHypothesis, count: int) -> NotLocated:
    return NotLocated(
        Reason.ELSEWHERE,
        f"{len(case.inliers)} points agree with one camera and {count} with another one: the scene repeats itself, "
        "or the image has several parts.",
        "Take it so that something is in it which the scene has once, and give it as the camera made it.",
    )


def _check_other_lens(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """Whether a camera of another lens, which was found on the way, explains nearly as much.

    One that lies apart by no more than its own uncertainty is none: then the covariance tells what is left open.
    """
    assert case.posed is not None
    fit = case.posed.fit
    apart = [
        int(each.agreeing.sum())
        for each in case.rivals
        if not _is_near(fit.camera, each.fit.camera, case.by) and _sigmas_apart(fit, each.fit) > config.max_apart
    ]
    if max(apart, default=0) <= config.max_rival * len(case.inliers):
        return None
    return _make_elsewhere(case, max(apart))


_NEAR_DEG, _NEAR_SHARE = 5.0, 0.1  # two cameras nearer than this, of the distance to the scene, are one
_NEAR_SHIFT = 0.1  # likewise of their principal points, over the longer side


def _is_near(one: CameraModel, other: CameraModel, by: QueryContext) -> bool:
    turn = np.degrees(Rotation.from_matrix(one.rotation @ other.rotation.T).magnitude())
    apart = np.linalg.norm(one.T_world_camera[:3, 3] - other.T_world_camera[:3, 3])
    shift = np.linalg.norm(one.lens.shift - other.lens.shift)
    return bool(turn < _NEAR_DEG and apart < _NEAR_SHARE * by.unit and shift < _NEAR_SHIFT * by.side)


def _check_halves(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """Whether the halves of the picture say different things of the camera, beyond what they leave open."""
    assert case.posed is not None
    fit, agreeing = case.posed.fit, case.inliers
    farthest = 0.0
    for axis in (0, 1):
        first = agreeing.pixels[:, axis] < np.median(agreeing.pixels[:, axis])
        halves = [
            optimize_camera(fit.camera, fit.camera.lens, agreeing.select(half), case.by.noise_px)
            for half in (first, ~first)
        ]
        farthest = max(farthest, _sigmas_apart(*halves))
    if farthest <= config.max_apart:
        return None
    return NotLocated(
        Reason.INCONSISTENT,
        "two halves of it put the camera in different places, farther apart than their uncertainty allows.",
        "Something has moved, or its lens bends straight lines: give its calibration.",
    )


def _sigmas_apart(one: CameraFit, other: CameraFit) -> float:
    """How far two cameras lie apart, in standard deviations; infinite where these are not known."""
    between = np.linalg.inv(one.camera.T_world_camera) @ other.camera.T_world_camera
    turn = Rotation.from_matrix(between[:3, :3]).as_rotvec()
    apart = np.concatenate([between[:3, 3], turn])
    covariance = sum(pose_covariance(fit.camera, fit.covariance) for fit in (one, other))
    if not np.isfinite(covariance).all():
        return math.inf
    squared = float(apart @ np.linalg.pinv(covariance, hermitian=True) @ apart)
    return math.sqrt(max(squared, 0.0) / len(apart))


_CHECKS: tuple[Check, ...] = (
    _check_chance,
    _check_lens,
    _check_coverage,
    _check_elsewhere,
    _check_other_lens,
    _check_halves,
)
_WHETHER_FOUND: tuple[Check, ...] = (_check_chance, _check_elsewhere)
