"""The lenses that a query image may have been taken with: what is known or assumed of each, and any other lens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.recon import poselib
from splatnode.recon.locating.outcome import NORMAL_95, LensSource, Located
from splatnode.recon.locating.pose_refinement import (
    LEAST_COSINE,
    PINHOLE,
    CameraFit,
    CameraModel,
    Correspondences,
    Lens,
    optimize_camera,
    undistort_pixels,
)
from splatnode.recon.registration import epipolar
from splatnode.recon.result.snapshot import KnownLenses

Array = npt.NDArray[np.float64]

# What is not known of a lens, as in recon/registration (self_calibration.py, incremental_mapper.py); lengths over the
# longer side.
_EXIF_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA, _ASPECT_SIGMA = 0.05, 0.02, 0.004, 0.001
_SAME_LENS_SIGMA, _SAME_RADIAL_SIGMA = 0.01, 0.005  # focusing changes the lens of one camera
# A calibration is right to these; with them an image is asked whether it is of that lens.
_GIVEN_SIGMA, _GIVEN_RADIAL_SIGMA, _GIVEN_SHIFT_SIGMA = 0.003, 0.005, 0.002
# Of a lens of which nothing is known: log focal, first radial coefficient, principal point, log aspect. An image that
# was cropped has its principal point anywhere, one of pixels that are not square any aspect.
_FREE_SIGMA, _FREE_RADIAL_SIGMA, _FREE_SHIFT_SIGMA, _FREE_ASPECT_SIGMA = 0.3, 0.1, 0.2, 0.15
_FOCALS = np.geomspace(0.45, 4.1, 10)  # over the longer side, 96 to 14 degrees of view: steps of 28 %
_LOG_ASPECTS = -0.29, -0.14, 0.14, 0.29  # 3 : 4 to 4 : 3, as where a recording's pixels are taken for square
_SAME_SHAPE = 0.01  # largest difference of two images' height over width
_SAME_FOCAL = 0.15  # of log focals: an EXIF focal length that may be of the result's own lens
_TOLD_APART = 0.002  # log focals of a result's lenses that are tried one by one


@dataclass(frozen=True, eq=False)
class LensAssumption:
    """A lens that an image is assumed to have, until its points say otherwise."""

    lens: Lens  # with the sigmas by which the assumption is tested
    source: LensSource

    @property
    def exact(self) -> bool:
        """Whether the lens stays as it is, where the image does not contradict it."""
        return self.source is LensSource.GIVEN


def make_trusted_lens(intrinsics: Intrinsics) -> Lens | None:
    """The lens of an image without distortion that came with trusted intrinsics; None where they are not."""
    return Lens(intrinsics.fx, PINHOLE, np.zeros(2), 0.0, 0.0, 0.0) if intrinsics.source != "exif" else None


def assume_lenses(lenses: KnownLenses, width: int, height: int, intrinsics: Intrinsics | None) -> list[LensAssumption]:
    """Returns the lenses that may be assumed of an image, the surest first; none where nothing is known.

    A lens that is given is all that is assumed. Otherwise the result's own lenses come first, then what EXIF states.
    """
    side = max(width, height)
    if intrinsics is not None and (certain := make_trusted_lens(intrinsics)) is not None:
        sigmas = _GIVEN_SIGMA, _GIVEN_RADIAL_SIGMA, _GIVEN_SHIFT_SIGMA * side
        tested = Lens(certain.focal, PINHOLE, np.zeros(2), *sigmas, log_aspect_sigma=_ASPECT_SIGMA)
        return [LensAssumption(tested, LensSource.GIVEN)]
    found = [LensAssumption(lens, LensSource.SCENE) for lens in find_scene_lenses(lenses, width, height, intrinsics)]
    stated = [] if intrinsics is None else [LensAssumption(make_exif_lens(intrinsics, side), LensSource.EXIF)]
    return found + stated


def find_scene_lenses(lenses: KnownLenses, width: int, height: int, intrinsics: Intrinsics | None) -> list[Lens]:
    """Those of the result's own lenses that took images of this shape, upright or not."""
    side, found = max(width, height), list[Lens]()
    shape = height / width
    for focal, radial, shift, known in zip(lenses.focals, lenses.radials, lenses.shifts, lenses.shapes, strict=True):
        upright = abs(shape - known) <= _SAME_SHAPE
        if not upright and abs(1.0 / shape - known) > _SAME_SHAPE:
            continue
        if intrinsics is not None and abs(np.log(intrinsics.fx / side / focal)) > _SAME_FOCAL:
            continue
        if any(abs(np.log(lens.focal / side / focal)) < _TOLD_APART for lens in found):
            continue
        moved = shift * side if upright else np.zeros(2)
        sigmas = _SAME_LENS_SIGMA, _SAME_RADIAL_SIGMA, _SHIFT_SIGMA * side
        found.append(
            Lens(float(focal) * side, (float(radial[0]), float(radial[1])), moved, *sigmas, 0.0, _ASPECT_SIGMA)
        )
    return found


def carry_over(before: Located, principal: Array, side: int) -> LensAssumption:
    """The lens that was found of the image before, of the same camera and size; `principal` is the nominal one."""
    focals = np.diag(before.K)[:2]
    log_sigma = math.log1p(before.claim.focal_percent / 100.0) / NORMAL_95
    lens = Lens(
        float(np.sqrt(focals.prod())),
        before.distortion,
        before.K[:2, 2] - principal,
        max(log_sigma, _SAME_LENS_SIGMA),
        _SAME_RADIAL_SIGMA,
        _SHIFT_SIGMA * side,
        float(np.log(focals[0] / focals[1])),
        _ASPECT_SIGMA,
    )
    return LensAssumption(lens, before.lens)


def make_exif_lens(intrinsics: Intrinsics, side: int) -> Lens:
    """The lens that EXIF tells, which is right to a few per cent."""
    sigmas = _EXIF_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA * side
    return Lens(intrinsics.fx, PINHOLE, np.zeros(2), *sigmas, 0.0, _ASPECT_SIGMA)


def make_typical_lens(lens: Lens, side: int) -> Lens:
    """A lens of any focal length near that of `lens` with what most lenses have: little of all else."""
    sigmas = _FREE_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA * side
    return Lens(lens.focal, PINHOLE, np.zeros(2), *sigmas, 0.0, _ASPECT_SIGMA)


def make_lens_grid(side: int, assumed: Sequence[LensAssumption]) -> list[Lens]:
    """Lenses from wide to long, each with what lies between it and the next, bent as the first that is assumed."""
    radial = assumed[0].lens.radial if assumed else PINHOLE
    return [free_lens(Lens(float(focal), radial, np.zeros(2), 0.0, 0.0, 0.0), side) for focal in side * _FOCALS]


def make_non_square_lenses(side: int) -> list[Lens]:
    """As `make_lens_grid`, of images whose pixels are not square."""
    return [replace(lens, log_aspect=log_aspect) for log_aspect in _LOG_ASPECTS for lens in make_lens_grid(side, ())]


def free_lens(lens: Lens, side: int) -> Lens:
    """Any lens near this one, of an image that may be a part of what the camera saw, or stretched."""
    return replace(
        lens,
        log_focal_sigma=_FREE_SIGMA,
        radial_sigma=_FREE_RADIAL_SIGMA,
        shift_sigma=_FREE_SHIFT_SIGMA * side,
        log_aspect_sigma=_FREE_ASPECT_SIGMA,
    )


def select_distinct_focals(assumed: Sequence[LensAssumption], least: float) -> list[Lens]:
    """Those of the lenses whose focal lengths differ by more than `least`, in logarithms."""
    found = list[Lens]()
    for each in assumed:
        if all(abs(np.log(each.lens.focal / lens.focal)) > least for lens in found):
            found.append(each.lens)
    return found


# The pose on which most correspondences agree, for a lens that is known or has to be tried.

Flags = npt.NDArray[np.bool_]

_SAMPLE = 3  # correspondences that define a pose
_ITERATIONS_OF_MANY = 3_000  # of RANSAC, where lenses are tried: they do for 13 % inliers
_MIN_LENGTH = 1e-12


class PoseSearchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The pose on which most correspondences agree, for a lens that is known or has to be tried."""

    search_px: float = 6.0  # reprojection error of an inlier while the lens is not exact, pixels at REFERENCE_SIDE
    max_error_px: float = 3.0  # of an inlier in the end
    iterations: int = 10_000  # of RANSAC, at most: they do for 9 % inliers
    rounds: int = 4  # of inliers and refinement; they have settled by then


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A camera, and the correspondences that agree with it."""

    fit: CameraFit
    prior: Lens  # that it was refined with
    agreeing: Flags  # (M,) of those that were given; at most one of a pixel, and of a landmark


def estimate_pose(
    known: Correspondences, lenses: Sequence[Lens], scale: float, noise_px: float, config: PoseSearchConfig
) -> PoseEstimate | None:
    """The camera that most correspondences agree with, of one of the `lenses`, refined; None where not a sample does.

    `scale` is pixels of the photograph for one at REFERENCE_SIDE; `noise_px` is of an observation, in its pixels.
    """
    most = config.iterations if len(lenses) == 1 else min(config.iterations, _ITERATIONS_OF_MANY)
    found = [(camera, lens) for lens in lenses if (camera := search_pose(known, lens, scale, config, most)) is not None]
    if not found:
        return None
    limit_px = config.search_px * scale
    camera, lens = max(found, key=lambda each: int(agreement(each[0], known, limit_px).sum()))
    return refine_pose(camera, known, lens, scale, noise_px, config)


def search_pose(
    known: Correspondences, lens: Lens, scale: float, config: PoseSearchConfig, most_iterations: int | None = None
) -> CameraModel | None:
    """The camera by random samples, with the lens as it is given; None where there are too few correspondences."""
    if len(known) <= _SAMPLE:
        return None
    pose, info = poselib.estimate_absolute_pose(
        undistort_pixels(known.pixels, lens),
        known.points,
        epipolar.pinhole(lens.focal),
        {
            "max_reproj_error": config.search_px * scale,
            "min_iterations": 500,
            "max_iterations": most_iterations or config.iterations,
            "seed": 0,
        },
    )
    if sum(info["inliers"]) <= _SAMPLE:
        return None
    return CameraModel(np.asarray(pose.R), np.asarray(pose.t), lens)


def refine_pose(
    camera: CameraModel, known: Correspondences, lens: Lens, scale: float, noise_px: float, config: PoseSearchConfig
) -> PoseEstimate | None:
    """The camera refined by its inliers, which are found again, until both have settled."""
    fit, agreeing = None, np.zeros(len(known), bool)
    for limit_px in np.linspace(config.search_px, config.max_error_px, config.rounds):
        agreeing = agreement(camera, known, limit_px * scale)
        if agreeing.sum() <= _SAMPLE:
            return None
        fit = optimize_camera(
            replace(camera, lens=camera.lens.copy_sigmas(lens)), lens, known.select(agreeing), noise_px
        )
        camera = fit.camera
    assert fit is not None
    return PoseEstimate(fit, lens, agreement(camera, known, config.max_error_px * scale))


def agreement(camera: CameraModel, known: Correspondences, limit_px: float) -> Flags:
    """(M,) which correspondences the camera explains: of a pixel the best one alone, and of a landmark.

    None is explained that the camera sees from elsewhere than the photographs that it was matched with: a feature does
    not look alike from the side, and from behind, as where a pattern was mirrored, it is not seen.
    """
    errors = camera.errors(known.points, known.pixels)
    along = known.points - camera.T_world_camera[:3, 3]
    cosine = (along * known.seen_along).sum(1) / np.maximum(np.linalg.norm(along, axis=1), _MIN_LENGTH)
    agreeing = (errors < limit_px) & (cosine > LEAST_COSINE)
    for kind in (known.feature_of, known.landmark_of):
        order = np.lexsort((errors, ~agreeing, kind))
        first = np.ones(len(order), bool)
        first[1:] = kind[order[1:]] != kind[order[:-1]]
        best = np.zeros(len(order), bool)
        best[order[first]] = True
        agreeing &= best
    return agreeing
