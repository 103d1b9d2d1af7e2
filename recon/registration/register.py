"""Registration: from keyframes and their verified pairs to cameras and sparse points, with their uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe, content_key, longer_side, principal_point
from splatnode.recon.geometry import undistort_rays
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import bundle, known_poses, lenses, mapper, own_lenses, uncertainty
from splatnode.recon.registration.config import RegistrationConfig
from splatnode.recon.registration.known_poses import GivenWorld
from splatnode.recon.registration.lenses import Grouping
from splatnode.recon.registration.mapping_problem import MapperView
from splatnode.recon.registration.patch_image import PatchImage, patch_image

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_DISPLACED = 0.0045  # of the longer side: a wider prior of a principal point was widened by what was found
_MIN_DEPTH = 1e-9  # median depth of the points, in the map's unit of length, in place of 0


@dataclass(frozen=True, eq=False)
class RegisteredCamera:
    """The estimated camera of a frame, in pixels of the frame at full size."""

    index: int  # position among the keyframes
    T_world_camera: Array  # (4, 4)
    lens: int  # cameras with the same number share a lens, relative to their longer side
    focal: float  # pixels
    principal: Array  # (2,) pixels
    radial: Array  # (2,) coefficients of r^2 and r^4 in the lens' distortion, as bundle.py has them
    rotation_sigma_deg: float  # after the best similarity; infinite where nothing is known
    centre_sigma_rel: float  # over the spread of the centres, after the best similarity; infinite likewise
    # (3, 3) of the centre, after the best similarity, in the frame and the squared unit of the world; NaN likewise
    centre_covariance: Array
    aspect: float = 1.0  # focal length down over that across
    own_lens: bool = False  # the lens that it was taken to share, or that was given, is refuted
    near_lens: int = -1  # the lens whose focal length it has to within `own_lenses.focal_sigma`; -1: its own alone
    displaced: bool = False  # the principal point is not where it was taken to be
    focal_sigma: float = np.inf  # of log focal; infinite where nothing is known

    @property
    def focals(self) -> Array:
        """(2,) across and down, pixels."""
        return self.focal * np.array([1.0, self.aspect])

    def normalise(self, pixels: Array) -> Array:
        """(M, 2) coordinates at depth 1, without distortion, of `pixels` (M, 2) of the frame at full size."""
        return undistort_rays((pixels - self.principal) / self.focals, np.tile(self.radial, (len(pixels), 1)))


@dataclass(frozen=True, eq=False)
class Registration:
    """Cameras and sparse points. The world is the first camera's frame; the median depth of the points is 1."""

    cameras: tuple[RegisteredCamera, ...]  # in the order of the keyframes
    points: Array  # (P, 3) world
    observed_by: npt.NDArray[np.int64]  # (O,) keyframe index
    observed_point: npt.NDArray[np.int64]  # (O,)
    observed_pixels: Array  # (O, 2) full-size pixels
    inlier_ratios: dict[tuple[int, int], float]  # the share of each pair's matches that agree with the poses
    focal_sigma: float  # of the logarithm of the least certain focal length; infinite where nothing is known
    median_angle_deg: float  # of the points' triangulation angles
    rms_px: float  # of the observations' errors, pixels at REFERENCE_SIDE
    given: GivenWorld | None = None  # the world of given poses that held cameras; None: none did


def register(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    config: RegistrationConfig,
    pause: Callable[[], None] = lambda: None,
) -> Registration | None:
    """The cameras of as many keyframes as can be registered together, or None when no two can.

    `pairs` holds the verified pairs by position (i < j). The result does not depend on the order of the keyframes.
    `pause` is called between steps and may raise to abandon the work.
    """
    if not pairs:
        return None
    order = sort_by_content(keyframes)
    ordered = [keyframes[index] for index in order]
    rank = np.argsort(order)
    built = _build(ordered, relabel_pairs(pairs, rank), config, pause)
    if built is None:
        return None
    found, grouping = built
    return make_registration(found.relabel(order), keyframes, [grouping.scales[i] for i in rank], config)


def sort_by_content(keyframes: Sequence[Keyframe]) -> list[int]:
    """Positions of the keyframes in the order in which they are registered, which is not that of their arrival."""
    return sorted(range(len(keyframes)), key=lambda index: content_key(keyframes[index]))


def relabel_pairs(pairs: Mapping[tuple[int, int], TwoView], new: Index) -> dict[tuple[int, int], TwoView]:
    """The pairs, sorted, with keyframes relabelled: keyframe i becomes keyframe `new[i]`."""
    found = {}
    for (i, j), pair in pairs.items():
        first, second = int(new[i]), int(new[j])
        found[min(first, second), max(first, second)] = pair if first < second else pair.swap()
    return dict(sorted(found.items()))


def _build(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    config: RegistrationConfig,
    pause: Callable[[], None],
) -> tuple[mapper.Map, Grouping] | None:
    """The map, in the pixels of its lenses, and their grouping: one lens for all sizes unless the map disagrees."""
    together, apart = (lenses.group(keyframes, across_sizes) for across_sizes in (True, False))
    built = _map(keyframes, pairs, together, config, pause)
    if built is None or together == apart:
        return None if built is None else (built, together)
    if not lenses.sizes_disagree(built.estimate, built.prior, built.loss, built.views[0], together, config.lenses):
        return built, together
    built = _map(keyframes, pairs, apart, config, pause)
    return None if built is None else (built, apart)


def _map(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    grouping: Grouping,
    config: RegistrationConfig,
    pause: Callable[[], None],
) -> mapper.Map | None:
    """The map of keyframes with the lenses of `grouping`, in the pixels of these."""
    images = patch_images(keyframes, grouping, config)
    known = lenses.candidates(keyframes, grouping, pairs, config.lenses)
    views, scaled = make_views(keyframes, grouping), convert_to_lens_pixels(pairs, grouping)
    return mapper.build_map(views, known, scaled, config.mapper, images, pause)


def patch_images(keyframes: Sequence[Keyframe], grouping: Grouping, config: RegistrationConfig) -> list[PatchImage]:
    """The keyframes' images in the pixels of their lenses, by which observations become exact."""
    settings = config.mapper.finishing.subpixel.patch_image
    return [
        patch_image(keyframe.frame.image, principal_point(keyframe.frame), settings).rescale(grouping.scales[i])
        for i, keyframe in enumerate(keyframes)
    ]


def make_views(keyframes: Sequence[Keyframe], grouping: Grouping) -> list[MapperView]:
    """The keyframes as the mapper sees them, in the pixels of their lenses."""
    return [
        MapperView(
            points=grouping.scales[i] * (keyframe.features.points - principal_point(keyframe.frame)),
            lens=grouping.lens_of[i],
            longer_side=grouping.longer_side,
        )
        for i, keyframe in enumerate(keyframes)
    ]


def convert_to_lens_pixels(
    pairs: Mapping[tuple[int, int], TwoView], grouping: Grouping
) -> dict[tuple[int, int], TwoView]:
    """The pairs in the pixels of their frames' lenses."""
    return {(i, j): pair.rescale(grouping.scales[i], grouping.scales[j]) for (i, j), pair in pairs.items()}


def make_registration(
    found: mapper.Map, keyframes: Sequence[Keyframe], scales: Sequence[float], config: RegistrationConfig
) -> Registration:
    """The map in the frame of the first registered keyframe, scaled to a median point depth of 1.

    `scales` are those of the keyframes: pixels of their lens, which the map is in, over their own pixels.
    """
    estimate = found.estimate
    order = sorted(found.views)
    sides = np.array([scale * longer_side(k.frame) for scale, k in zip(scales, keyframes, strict=True)])
    doubted, prior = own_lenses.widen_lens_priors(estimate, found.prior, sides, config.mapper.own_lenses)
    covariance = bundle.covariance(doubted, prior, found.loss, found.views[0])
    unit = 1.0 / max(known_poses.distance(estimate, order), _MIN_DEPTH)
    rotation0, translation0 = estimate.rotations[order[0]], estimate.translations[order[0]]
    rotation_sigmas, centre_sigmas = uncertainty.camera_sigmas(estimate, covariance, order)
    covariances = unit**2 * rotation0 @ uncertainty.centre_covariances(estimate, covariance, order) @ rotation0.T
    focal_sigmas = uncertainty.sigmas(covariance.log_focals)
    cameras = []
    for position, i in enumerate(order):
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = rotation0 @ estimate.rotations[i].T
        T_world_camera[:3, 3] = unit * (translation0 - T_world_camera[:3, :3] @ estimate.translations[i])
        lens = estimate.lens_of_camera[i]
        cameras.append(
            RegisteredCamera(
                index=i,
                T_world_camera=T_world_camera,
                lens=int(lens),
                focal=float(np.exp(estimate.log_focals[lens])) / scales[i],
                principal=principal_point(keyframes[i].frame) + estimate.shifts[lens] / scales[i],
                radial=estimate.radials[lens].copy(),
                rotation_sigma_deg=float(rotation_sigmas[position]),
                centre_sigma_rel=float(centre_sigmas[position]),
                centre_covariance=covariances[position],
                aspect=float(estimate.aspects[lens]),
                near_lens=own_lenses.find_common_lens(found.prior, int(lens), config.mapper.own_lenses),
                displaced=bool(found.prior.shift_sigmas[lens] > _DISPLACED * sides[i]),
                focal_sigma=float(focal_sigmas[i]),
                own_lens=bool(lens >= found.num_common),
            )
        )
    principal = np.stack([principal_point(keyframe.frame) for keyframe in keyframes])
    camera_of = estimate.camera_of
    return Registration(
        cameras=tuple(cameras),
        points=unit * (estimate.points @ rotation0.T + translation0),
        observed_by=camera_of,
        observed_point=estimate.point_of,
        observed_pixels=estimate.pixels / np.array(scales)[camera_of, None] + principal[camera_of],
        inlier_ratios=found.inlier_ratios,
        focal_sigma=float(focal_sigmas[order].max()),
        median_angle_deg=found.median_angle_deg,
        rms_px=found.rms_px,
    )
