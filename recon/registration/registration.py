"""Registration: from keyframes and their verified pairs to cameras and sparse points, with their uncertainty."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import lenses as opencv
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import SQUARE_TOLERANCE, undistort_frame
from splatnode.capture.process.config import Internal
from splatnode.capture.rig import TOLERANCE_S, Rig, form_mounted_rig
from splatnode.recon.geometry import distortion, undistort_rays
from splatnode.recon.keyframes import (
    Features,
    Keyframe,
    content_key,
    longer_side,
    principal_point,
    resize_image,
    resize_mask,
)
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration import (
    bundle_adjustment,
    incremental_mapper,
    known_poses,
    mapping_problem,
    rigs,
    self_calibration,
)
from splatnode.recon.registration.known_poses import GivenWorld
from splatnode.recon.registration.mapping_problem import Lens, MapperInput, MapperView, SparseModel
from splatnode.recon.registration.self_calibration import LEAST_SHIFT, Grouping
from splatnode.recon.registration.subpixel import PatchImage, patch_image
from splatnode.recon.threads import BACKGROUND, RunContext

# The configuration of registration: the lenses, and the mapper.


class RegistrationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The configuration of registration: the lenses, and the mapper."""

    lenses: Internal[self_calibration.LensGroupingConfig] = self_calibration.LensGroupingConfig()
    mapper: Internal[incremental_mapper.MapperConfig] = incremental_mapper.MapperConfig()
    # Given poses are priors of cameras with a known lens; images that contradict one reject it. --poses-sigma sets it.
    # Otherwise they are only compared with the images' cameras
    trust_poses: bool = False
    # Drift of trusted poses from the first image on: standard deviation of a step's error in each direction, and of all
    # lengths alike, as a share; 0: poses are absolute. --poses-drift sets it
    poses_drift: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.0
    # And of the turn about each axis that has grown after a metre, degrees; it grows with the root of the way
    poses_drift_deg: Annotated[float, msgspec.Meta(ge=0, le=90)] = 0.0
    # Cameras that are fixed to each other, as `--rig FILE` or a recording tells; None: what their frame sets tell
    rig: Internal[Rig | None] = None


Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_DISPLACED = 0.0045  # of the longer side: a wider prior of a principal point was widened by what was found
_MIN_DEPTH = 1e-9  # median depth of the points, in the model's unit of length, in place of 0


@dataclass(frozen=True, eq=False)
class RegisteredCamera:
    """The estimated camera of a frame, in pixels of the frame at full size."""

    index: int  # position among the keyframes
    T_world_camera: Array  # (4, 4)
    lens: int  # cameras with the same number share a lens, relative to their longer side
    focal: float  # pixels
    principal: Array  # (2,) pixels
    radial: Array  # (2,) coefficients of r^2 and r^4 in the lens' distortion, as bundle_adjustment.py has them
    rotation_sigma_deg: float  # after the best similarity; infinite where nothing is known
    centre_sigma_rel: float  # over the spread of the centres, after the best similarity; infinite likewise
    # (3, 3) of the centre, after the best similarity, in the frame and the squared unit of the world; NaN likewise
    centre_covariance: Array
    aspect: float = 1.0  # focal length down over that across
    skew: float = 0.0  # how far a row moves across for one down, at depth 1
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
        rays = (pixels - self.principal) / self.focals
        rays[:, 0] -= self.skew * rays[:, 1]
        return undistort_rays(rays, np.tile(self.radial, (len(pixels), 1)))


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
    rig: rigs.RigEstimate | None = None  # that its cameras are on; None: they are on none

    @property
    def image_part(self) -> Registration:
        """Returns it without its rig and the cameras that the rig alone places, of which images tell nothing."""
        placed = () if self.rig is None else self.rig.placed
        return replace(self, cameras=tuple(each for each in self.cameras if each.index not in placed), rig=None)


def register(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    config: RegistrationConfig,
    run: RunContext = BACKGROUND,
    tolerance_s: float = TOLERANCE_S,
) -> Registration | None:
    """The cameras of as many keyframes as can be registered together, or None when no two can.

    `pairs` holds the verified pairs by position (i < j). The result does not depend on the order of the keyframes.
    Images of different cameras are taken together where at most `tolerance_s` is between them. It pauses
    between steps, which may raise to abandon the work.
    """
    if not pairs:
        return None
    order = sort_by_content(keyframes)
    ordered = [keyframes[index] for index in order]
    rank = np.argsort(order)
    built = _build(ordered, relabel_pairs(pairs, rank), config, run)
    if built is None:
        return None
    found, grouping = built
    scales = [grouping.scales[i] for i in rank]
    alone = make_registration(found.relabel(order), keyframes, scales, config)
    run.pause()
    given = config.rig or form_mounted_rig(each.frame for each in keyframes)
    on_rig = rigs.adjust_with_rig(found, ordered, given, tolerance_s)
    if on_rig is None:
        return alone
    adjusted, rig = on_rig[0].relabel(order), on_rig[1].relabel(order)
    whole = replace(adjusted, views=(*adjusted.views, *rig.placed))
    together = make_registration(whole, keyframes, scales, config)
    return _keep_sigmas(together, alone, rig.rescale(known_poses.distance(adjusted.estimate, adjusted.views)))


def _keep_sigmas(together: Registration, alone: Registration, rig: rigs.RigEstimate) -> Registration:
    """The registration on a rig, no camera of which is claimed to be better known than by images alone."""
    before = {camera.index: camera for camera in alone.cameras}
    cameras = [
        camera
        if camera.index not in before
        else replace(
            camera,
            rotation_sigma_deg=max(camera.rotation_sigma_deg, before[camera.index].rotation_sigma_deg),
            centre_sigma_rel=max(camera.centre_sigma_rel, before[camera.index].centre_sigma_rel),
            centre_covariance=before[camera.index].centre_covariance,
        )
        for camera in together.cameras
    ]
    focal_sigma = max(together.focal_sigma, alone.focal_sigma)
    return replace(together, cameras=tuple(cameras), focal_sigma=focal_sigma, rig=rig)


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
    run: RunContext,
) -> tuple[incremental_mapper.MapperResult, Grouping] | None:
    """The model, in the pixels of its lenses, and their grouping: one lens for all sizes unless the model disagrees."""
    together, apart = (self_calibration.group(keyframes, across_sizes) for across_sizes in (True, False))
    built = _build_model(keyframes, pairs, together, config, run)
    if built is None or together == apart:
        return None if built is None else (built, together)
    if not self_calibration.sizes_disagree(
        built.estimate, built.prior, built.loss, built.views[0], together, config.lenses
    ):
        return built, together
    built = _build_model(keyframes, pairs, apart, config, run)
    return None if built is None else (built, apart)


def _build_model(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    grouping: Grouping,
    config: RegistrationConfig,
    run: RunContext,
) -> incremental_mapper.MapperResult | None:
    """The model of keyframes with the lenses of `grouping`, in the pixels of these."""
    images = patch_images(keyframes, grouping, config)
    known = self_calibration.candidates(keyframes, grouping, pairs, config.lenses)
    views, scaled = make_views(keyframes, grouping), convert_to_lens_pixels(pairs, grouping)
    return incremental_mapper.build_model(views, known, scaled, config.mapper, images, run)


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
    found: incremental_mapper.MapperResult,
    keyframes: Sequence[Keyframe],
    scales: Sequence[float],
    config: RegistrationConfig,
) -> Registration:
    """The model in the frame of the first registered keyframe, scaled to a median point depth of 1.

    `scales` are those of the keyframes: pixels of their lens, which the model is in, over their own pixels.
    """
    estimate = found.estimate
    order = sorted(found.views)
    sides = np.array([scale * longer_side(k.frame) for scale, k in zip(scales, keyframes, strict=True)])
    doubted, prior = self_calibration.widen_lens_priors(estimate, found.prior, sides, config.mapper.own_lenses)
    covariance = bundle_adjustment.covariance(doubted, prior, found.loss, found.views[0])
    unit = 1.0 / max(known_poses.distance(estimate, order), _MIN_DEPTH)
    rotation0, translation0 = estimate.rotations[order[0]], estimate.translations[order[0]]
    rotation_sigmas, centre_sigmas = bundle_adjustment.camera_sigmas(estimate, covariance, order)
    covariances = unit**2 * rotation0 @ bundle_adjustment.centre_covariances(estimate, covariance, order) @ rotation0.T
    focal_sigmas = bundle_adjustment.sigmas(covariance.log_focals)
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
                skew=float(estimate.all_skews[lens]),
                near_lens=self_calibration.find_common_lens(found.prior, int(lens), config.mapper.own_lenses),
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


# Continuation: further keyframes registered beside known cameras, quickly, until all can be registered anew.
#
# The known cameras start the model; new views are resected from the points that they share with them, and everything is
# adjusted. No other first pair or focal length is tried and no patches are aligned, so that errors of the start
# remain.


def extend_registration(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    start: Sequence[RegisteredCamera],
    config: RegistrationConfig,
) -> Registration | None:
    """The cameras `start` and those of all keyframes that can be registered beside them; None where it fails.

    `start` and `pairs` (i < j) number the keyframes by their positions. The world is as `register` has it.
    """
    grouping = _grouping(keyframes, start)
    if grouping is None:
        return None
    known = self_calibration.candidates(keyframes, grouping, pairs, config.lenses)
    views, scaled = make_views(keyframes, grouping), convert_to_lens_pixels(pairs, grouping)
    max_tracks = config.mapper.max_growing_tracks
    problem = mapping_problem.prepare(views, known, scaled, max_tracks, max_tracks)
    first = _make_camera_map(keyframes, grouping, known, start)
    problem, first = _add_own_lenses(problem, first, keyframes, grouping, start)
    settings = config.mapper.incremental
    partial = incremental_mapper.adjust_quickly(problem, first, incremental_mapper.SETTLED_TOLERANCE, settings)
    if len(partial.estimate.points) < settings.min_points:
        return None
    finished = incremental_mapper.run_final_adjustment(
        problem, incremental_mapper.extend(problem, partial, settings), (), config.mapper.finishing
    )
    if finished is None:
        return None
    problem, finished = incremental_mapper.give_own_lenses(problem, finished, (), config.mapper)
    found = incremental_mapper.make_result(problem, finished, settings.triangulation.max_error_px, len(known))
    return make_registration(found, keyframes, grouping.scales, config)


def _grouping(keyframes: Sequence[Keyframe], start: Sequence[RegisteredCamera]) -> Grouping | None:
    """The frames grouped by lens as the cameras `start` are; None where no grouping fits, or a lens has no camera."""
    shared = [camera for camera in start if not camera.own_lens]
    for across_sizes in (True, False):
        grouping = self_calibration.group(keyframes, across_sizes)
        if not shared:
            return grouping if len(set(grouping.lens_of)) == 1 else None
        lens_of = {(grouping.lens_of[camera.index], camera.lens) for camera in shared}
        if len(lens_of) == len({now for now, _ in lens_of}) == len({then for _, then in lens_of}):
            return grouping if len(lens_of) == len(set(grouping.lens_of)) else None
    return None


def _make_camera_map(
    keyframes: Sequence[Keyframe], grouping: Grouping, known: Sequence[Lens], start: Sequence[RegisteredCamera]
) -> SparseModel:
    """A model of the known cameras without points, in the pixels of their lenses; only focal lengths are free."""
    count, num_lenses = len(keyframes), len(known)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    log_focals, radials, shifts = np.zeros(num_lenses), np.zeros((num_lenses, 2)), np.zeros((num_lenses, 2))
    for camera in sorted(start, key=lambda each: each.own_lens):
        index, lens = camera.index, grouping.lens_of[camera.index]
        rotations[index] = camera.T_world_camera[:3, :3].T
        translations[index] = -rotations[index] @ camera.T_world_camera[:3, 3]
        if camera.own_lens and log_focals[lens] != 0.0:
            continue
        log_focals[lens] = np.log(grouping.scales[index] * camera.focal)
        radials[lens] = camera.radial
        nominal = principal_point(keyframes[index].frame)
        shifts[lens] = grouping.scales[index] * (camera.principal - nominal)
    estimate = bundle_adjustment.make_empty_problem(
        rotations, translations, np.array(grouping.lens_of), log_focals, radials, shifts
    )
    prior = bundle_adjustment.focal_prior(log_focals, np.array([lens.sigma for lens in known]))
    return SparseModel(tuple(camera.index for camera in start), estimate, prior, np.zeros(0, np.int64))


def _add_own_lenses(
    problem: MapperInput,
    first: SparseModel,
    keyframes: Sequence[Keyframe],
    grouping: Grouping,
    start: Sequence[RegisteredCamera],
) -> tuple[MapperInput, SparseModel]:
    """Both, with lenses of their own for the known cameras that have one."""
    registered = first.registered
    for camera in start:
        if not camera.own_lens:
            continue
        scale = grouping.scales[camera.index]
        problem, first = self_calibration.add_lens(problem, first, camera.index, scale * camera.focal)
        known = first.estimate
        radials, shifts, log_aspects, skews = (
            values.copy() for values in (known.radials, known.shifts, np.log(known.aspects), known.all_skews)
        )
        radials[-1], log_aspects[-1], skews[-1] = camera.radial, np.log(camera.aspect), camera.skew
        shifts[-1] = scale * (camera.principal - principal_point(keyframes[camera.index].frame))
        known = replace(known, radials=radials, shifts=shifts, log_aspects=log_aspects, skews=skews)
        first = replace(first, estimate=known)
    return problem, replace(first, registered=registered)


# Photographs without the distortion that registration estimated, for all that comes after the poses.
#
# Stereo, seeding, refinement and what is published are those of a pinhole. The poses, their verification and the
# landmarks keep the photographs as they were taken, of which the radial coefficients are.

log = logging.getLogger(__name__)


_DETAIL = 2  # times the modelled size: what is straightened, so that resampling twice costs no sharpness


def undistort_keyframes(graph: ViewGraph, registration: Registration) -> tuple[ViewGraph, Registration]:
    """Both, as if pinholes had taken the photographs whose lens bends lines enough to be sure of it (LEAST_SHIFT).

    So are photographs whose pixels are not square, and those that are sheared.

    Such a keyframe has its `lens`; its frame is at most twice as large as it is modelled. Observations beyond what it
    shows are left out. What came is returned where no lens is such, or one is estimated that folds its picture over.
    """
    lenses = {}
    for camera in registration.cameras:
        lens = _make_intrinsics(camera, graph.keyframes[camera.index].frame)
        if abs(corner_shift(lens)) > LEAST_SHIFT or max(abs(camera.aspect - 1.0), abs(camera.skew)) > SQUARE_TOLERANCE:
            lenses[camera.index] = lens
    if not lenses:
        return graph, registration
    keyframes = list(graph.keyframes)
    try:
        for index, lens in lenses.items():
            keyframes[index] = undistort_keyframe(keyframes[index], lens)
    except ValueError as error:
        log.warning("the photographs stay as they are: the estimated lens cannot be: %s", error)
        return graph, registration
    return replace(graph, keyframes=tuple(keyframes)), _undistort_observations(keyframes, registration)


def apply_known_lenses(
    registration: Registration, graph: ViewGraph, known: Mapping[str, Intrinsics | None]
) -> Registration:
    """The registration with lenses that are `known`, by keyframe, of all cameras that share them.

    What continues an estimate has fewer points, which tell less of a lens than those that it was estimated from before.
    """
    lenses = {}
    for camera in registration.cameras:
        keyframe = graph.keyframes[camera.index]
        if (lens := known.get(keyframe.name)) is not None:
            lenses[camera.lens] = lens
    cameras = []
    for camera in registration.cameras:
        if (lens := lenses.get(camera.lens)) is not None:
            frame = graph.keyframes[camera.index].frame
            own = lens.resized(frame.width, frame.height)
            principal = np.array([own.cx, own.cy])
            camera = replace(
                camera,
                focal=own.fx,
                aspect=own.fy / own.fx,
                skew=own.skew,
                principal=principal,
                radial=np.array(radial_of(own)),
            )
        cameras.append(camera)
    return replace(registration, cameras=tuple(cameras))


def undistort_keyframe(keyframe: Keyframe, lens: Intrinsics) -> Keyframe:
    """The keyframe as a pinhole would have seen it. Raises ValueError where `lens` folds its picture over."""
    height, width = keyframe.image.shape[:2]
    image = resize_image(keyframe.frame.image, _DETAIL * max(width, height))
    mask = keyframe.frame.mask
    mask = None if mask is None else resize_mask(mask, *image.shape[:2])
    frame = undistort_frame(replace(keyframe.frame, image=image, mask=mask, intrinsics=lens))
    shown = frame.image
    if shown.shape[:2] != (height, width):
        shown = cv2.resize(shown, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    points = undistort_pixels(keyframe.features.points, lens, _pinhole(frame))
    return Keyframe(frame, shown, _replace_points(keyframe.features, points), lens, keyframe.moving)


def undistort_pixels(pixels: Array, lens: Intrinsics, pinhole: Intrinsics) -> Array:
    """(M, 2) where `pinhole` shows what `lens` shows at `pixels` (M, 2), each in pixels of its own picture."""
    return opencv.project_opencv(opencv.unproject_opencv(pixels, lens), pinhole) if len(pixels) else pixels


def corner_shift(lens: Intrinsics | None) -> float:
    """Returns how far distortion moves the corner farthest from the principal point, over the longer side.

    Above 0 away from that point; 0 without a lens.
    """
    if lens is None or not lens.distortion:
        return 0.0
    across = max(lens.cx, lens.width - lens.cx) / lens.fx
    down = max(lens.cy, lens.height - lens.cy) / lens.fy
    corner = np.hypot(across, down)
    moved = distortion(corner**2, np.array(radial_of(lens))) - 1.0
    return float(moved * corner * lens.fx / max(lens.width, lens.height))


def radial_of(lens: Intrinsics | None) -> tuple[float, float]:
    """The radial coefficients of a lens that registration estimated; without one, those of a pinhole."""
    if lens is None or not lens.distortion:
        return 0.0, 0.0
    first, second, *_ = (*lens.distortion, 0.0)
    return first, second


def _make_intrinsics(camera: RegisteredCamera, frame: Frame) -> Intrinsics:
    cx, cy = (float(value) for value in camera.principal)
    radial = (*camera.radial.tolist(), 0.0, 0.0) if camera.radial.any() else ()
    fx, fy = (float(value) for value in camera.focals)
    return Intrinsics(frame.width, frame.height, fx, fy, cx, cy, "estimated", radial, skew=camera.skew)


def _undistort_observations(keyframes: list[Keyframe], registration: Registration) -> Registration:
    """The registration of these keyframes, some of which are straight, in their pixels."""
    pixels, inside = registration.observed_pixels.copy(), np.ones(len(registration.observed_by), bool)
    cameras = []
    for camera in registration.cameras:
        keyframe = keyframes[camera.index]
        if keyframe.lens is None:
            cameras.append(camera)
            continue
        pinhole, own = _pinhole(keyframe.frame), registration.observed_by == camera.index
        pixels[own] = undistort_pixels(pixels[own], keyframe.lens, pinhole)
        inside[own] = np.all((pixels[own] >= 0) & (pixels[own] < (pinhole.width, pinhole.height)), axis=1)
        principal = np.array([pinhole.cx, pinhole.cy])
        cameras.append(replace(camera, focal=pinhole.fx, principal=principal, radial=np.zeros(2), aspect=1.0, skew=0.0))
    return replace(
        registration,
        cameras=tuple(cameras),
        observed_by=registration.observed_by[inside],
        observed_point=registration.observed_point[inside],
        observed_pixels=pixels[inside],
    )


def _pinhole(frame: Frame) -> Intrinsics:
    if frame.intrinsics is None:
        raise AssertionError("a straightened frame has the intrinsics of its pinhole")
    return frame.intrinsics


def _replace_points(features: Features, points: Array) -> Features:
    return Features(points, features.descriptors, features.point_of, features.tilt)
