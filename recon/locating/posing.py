"""The pose on which most correspondences agree, for a lens that is known or has to be tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon import poselib
from splatnode.recon.locating.camera_model import CameraModel, Lens, undistort_pixels
from splatnode.recon.locating.correspondences import LEAST_COSINE, Correspondences
from splatnode.recon.locating.refinement import CameraFit, optimize_camera
from splatnode.recon.registration import epipolar

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_SAMPLE = 3  # correspondences that define a pose
_ITERATIONS_OF_MANY = 3_000  # of RANSAC, where lenses are tried: they do for 13 % inliers
_MIN_LENGTH = 1e-12


class PoseSearchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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
