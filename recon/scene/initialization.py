"""Initialisation: the scene that has not been optimised, seeded from point maps of registered cameras."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree

from splatnode.capture.frame import Intrinsics
from splatnode.capture.process.config import Internal
from splatnode.recon import keyframes, priors
from splatnode.recon.core import library
from splatnode.recon.geometry import quat_from_matrix
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors import Pointmap, compute_consistent_shares, compute_modelled_K, find_consistent_pixels
from splatnode.recon.registration.registration import Registration
from splatnode.recon.result.snapshot import encode_unconfirmed
from splatnode.recon.scene import SH_C0, Exposure, Gaussians, Scene, TrainingView, concatenate, logit
from splatnode.recon.scene import background as scene_background
from splatnode.recon.threads import map_parallel

# Partitions an image into pieces, each of which one colour and one depth explain well enough.

CHANNELS = 4  # of a pixel's features: three of colour and one of depth (kChannels of recon/core/partition.cpp)


def partition(
    features: npt.NDArray[np.float32],  # (h, w, 4)
    weights: npt.NDArray[np.float32],  # (h, w), positive
    wanted: npt.NDArray[np.bool_],  # (h, w)
    *,
    tile_px: int,
    min_area_px: int,
    max_error: float,
    noise_variance: float,
) -> tuple[npt.NDArray[np.int32], int]:
    """(h, w) the label of the piece that each pixel belongs to, -1 where it is not wanted; and the number of pieces.

    A piece is cut in two by a straight line, again and again, until its error is at most `max_error` or its area at
    most `min_area_px` pixels. The error is the squared deviation from the piece's mean, less `noise_variance`, weighted
    and summed over pixels and channels. No piece crosses the lines of a grid of `tile_px`. A piece may be in several
    parts where unwanted pixels lie between them. Raises ValueError for arrays of other shapes, or sizes out of range.
    """
    if features.ndim != 3 or features.shape[2] != CHANNELS or not wanted.shape == weights.shape == features.shape[:2]:
        shapes = f"{features.shape}, {weights.shape} and {wanted.shape}"
        raise ValueError(f"features must be (h, w, {CHANNELS}), weights and wanted (h, w), got {shapes}")
    if not 1 <= tile_px < 2**14 or min_area_px < 1:  # the core keeps places in a tile as int16
        raise ValueError(f"tile_px must be from 1 to 16383 and min_area_px positive, got {tile_px} and {min_area_px}")
    values = np.ascontiguousarray(features, np.float32)
    counted = np.ascontiguousarray(weights, np.float32)
    mask = np.ascontiguousarray(wanted, np.uint8)
    labels = np.empty(wanted.shape, np.int32)
    height, width = wanted.shape
    task = _Partition(
        values.ctypes.data, counted.ctypes.data, mask.ctypes.data,
        width, height, tile_px, min_area_px, max_error, noise_variance,
    )  # fmt: skip
    count = library().core_partition(ctypes.byref(task), ctypes.c_void_p(labels.ctypes.data))
    return labels, count


class _Partition(ctypes.Structure):
    """The struct Partition of recon/core/partition.cpp."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("features", "weights", "wanted")),
        *((name, ctypes.c_int32) for name in ("width", "height", "tile", "smallest")),
        *((name, ctypes.c_float) for name in ("most_error", "noise")),
    ]


# Contrast masking: a difference of colour is visible in full on a plain surface, and less where contrast is strong.

# Standard deviation of the colours, in [0, 1], around a pixel at which half of a squared difference is visible.
# Half as much changed nothing (`PLAIN` in docs/tried.md).
MASKING_STD = 0.03
WINDOW_PX = 13.0  # side of the square around a pixel that masks it, at the reference's size: SSIM's window has 11

Float32 = npt.NDArray[np.float32]


def visibility(image: Float32, scale: float) -> Float32:
    """(h, w) factors in (0, 1] by which differences from an `image` (h, w, 3) in [0, 1] count.

    SSIM weighs a difference of structure in the same way (Wang et al. 2004): by the variance around it. `scale` is the
    image's size over the reference's (`REFERENCE_PX`).
    """
    side = 2 * round(WINDOW_PX * scale / 2) + 1
    mean = cv2.blur(image, (side, side))
    variance = np.maximum(cv2.blur(image**2, (side, side)) - mean**2, 0.0).mean(2)
    return np.asarray(MASKING_STD / np.sqrt(variance + MASKING_STD**2), np.float32)


# Gaussian initialization: the paper's confidence-ranked down-sampling, then one Gaussian for each piece of equal colour
# and depth.
#
# A piece is as large as its error allows (`partition`), with the same visible error everywhere (contrast masking):
# that is the best use of a number of Gaussians. Errors are measured in photographs of a fixed size, so that the number
# of Gaussians follows from what there is to see and not from how many pixels show it.

Mask = npt.NDArray[np.bool_]
Array = npt.NDArray[np.float64]

REFERENCE_PX = 512  # longer side of the photographs in whose pixels the configuration counts: the default size
PIXEL_VARIANCE = 1 / 12  # pixels squared, along each axis: a pixel is a square, not a point
MIN_COSINE = 0.25  # between normal and line of sight, 76 degrees: beyond, a surface is known badly
MIN_NORMAL_LENGTH = 0.3  # of a piece's mean normal: shorter ones are means of normals that contradict each other
MOST = 0.5  # of a piece's pixels
ATTEMPTS = 12  # to have at most a given number of Gaussians; then an even choice of them is kept
MIN_COARSENING = 1.1  # factor by which each attempt is to have fewer pieces
ERROR_EXPONENT = 1.3  # a piece's error grows a little faster than its area


class GaussianInitializationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Gaussian initialization: the paper's confidence-ranked down-sampling, then one Gaussian for each piece of equal
    colour and depth."""

    depth_tolerance: Internal[float] = 0.02  # theta of equation 16, relative to the depth
    # A pixel is redundant only beside a point whose footprint is at most this larger
    max_footprint_ratio: Internal[float] = 1.5
    min_confidence: Internal[float] = 0.05  # least confidence of stereo, in [0, 1]: pixels below get no Gaussian
    max_side_px: Internal[int] = 64  # side of the squares of a grid that no piece reaches across
    min_area_px: Internal[float] = 3.0  # pieces of at most this area are not cut
    # Largest error of a piece: squared visible deviation of colours in [0, 1], over pixels and channels
    max_error: float = 0.0021
    # A relative difference of depth counts as this many times a difference of colour
    depth_weight: Internal[float] = 1.0
    noise: Internal[float] = 0.01  # standard deviation of colours in [0, 1] that is not worth a Gaussian
    footprint: Internal[float] = 1.2  # standard deviations of a new Gaussian across, over its piece's
    thickness: Internal[float] = 1.0  # its standard deviation along the normal, over the smaller one across
    opacity: Internal[float] = 0.5  # of a new Gaussian


def find_redundant_pixels(pointmaps: Sequence[Pointmap], config: GaussianInitializationConfig) -> list[Mask]:
    """For each point map the pixels (h, w) that a more confident map already covers (equations 14 to 17).

    Beyond the paper, a pixel is kept where the other map's point was seen from so far away that detail would be lost.
    """
    score = [float(pointmap.confidence.mean()) for pointmap in pointmaps]  # equation 14

    def find_covered(j: int) -> Mask:
        target = pointmaps[j]
        mask = np.zeros(target.depth.shape, bool)
        for i in range(len(pointmaps)):
            if (score[i], -i) > (score[j], -j):
                projected, footprint = priors.project_nearest(pointmaps[i], target)
                near = np.abs(projected - target.depth) < config.depth_tolerance * target.depth
                own = target.depth / target.K[0, 0]
                mask |= near & (footprint < config.max_footprint_ratio * own)
        return mask & (target.depth > 0)

    return map_parallel(find_covered, range(len(pointmaps)))


def gaussians_from_pointmap(
    pointmap: Pointmap,
    image: npt.NDArray[np.uint8],
    wanted: Mask,
    config: GaussianInitializationConfig,
    sure: Mask | None = None,
) -> Gaussians:
    """One Gaussian for each piece of the `wanted` (h, w) pixels of a keyframe's `image` (h, w, 3).

    Each lies on its piece's surface and has the piece's mean colour, centre and extent there (moment matching). It
    counts as seen by two photographs where most of its pixels are `sure` (h, w); None: all are.
    """
    labels, count = _segment_at_reference_size(pointmap, image, wanted & (pointmap.depth > 0), config)
    wanted = labels >= 0
    piece = labels[wanted]
    pixels = np.bincount(piece, minlength=count)
    rows, columns = np.nonzero(wanted)
    u, v = columns + 0.5, rows + 0.5

    def mean(values: npt.NDArray) -> Array:
        return np.bincount(piece, values, minlength=count) / pixels

    centre = np.column_stack([mean(u), mean(v)])
    inverse_depth = mean(1.0 / pointmap.depth[wanted])
    colour = np.column_stack([mean(image[..., channel][wanted] / 255.0) for channel in range(3)])
    normal = np.column_stack([mean(pointmap.normal[..., axis][wanted]) for axis in range(3)])
    uu, vv = (mean(x * x) - centre[:, i] ** 2 + PIXEL_VARIANCE for i, x in enumerate((u, v)))
    uv = mean(u * v) - centre[:, 0] * centre[:, 1]
    spread = np.stack([np.stack([uu, uv], 1), np.stack([uv, vv], 1)], 1)
    seeded = _place_on_surface(pointmap, centre, spread, inverse_depth, normal, colour, config)
    if sure is None:
        return seeded
    seen = torch.from_numpy(mean(sure[wanted]) >= MOST)
    return replace(
        seeded, source_frame=torch.where(seen, pointmap.frame_id, encode_unconfirmed(pointmap.frame_id)).int()
    )


def _initialize_gaussians(
    pointmap: Pointmap, image: npt.NDArray[np.uint8], wanted: Mask, sure: Mask, config: GaussianInitializationConfig
) -> Gaussians:
    return gaussians_from_pointmap(pointmap, image, wanted, config, sure)


def _segment_at_reference_size(
    pointmap: Pointmap, image: npt.NDArray[np.uint8], wanted: Mask, config: GaussianInitializationConfig
) -> tuple[npt.NDArray[np.int32], int]:
    """(h, w) the label of the piece that each pixel belongs to, -1 where it is not wanted; and the number of pieces.

    Images above the reference's size are shrunk to it before they are cut: detail that only more pixels show is no
    reason for more Gaussians.
    """
    scale = max(wanted.shape) / REFERENCE_PX
    if scale > 1:
        height, width = wanted.shape
        size = (max(1, round(width / scale)), max(1, round(height / scale)))
        depth = np.asarray(cv2.resize(pointmap.depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
        there = cv2.resize(wanted.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        colour = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        labels, _ = _segment_image(depth, colour, there, 1.0, config)
        labels = np.asarray(cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST), np.int32)
        found, numbers = np.unique(labels[wanted], return_inverse=True)
        labels = np.full(wanted.shape, -1, np.int32)
        labels[wanted] = numbers - (1 if len(found) and found[0] < 0 else 0)
        return labels, int(labels.max(initial=-1)) + 1
    return _segment_image(pointmap.depth, image, wanted, scale, config)


def _segment_image(
    depth: npt.NDArray[np.float32],
    image: npt.NDArray[np.uint8],
    wanted: Mask,
    scale: float,
    config: GaussianInitializationConfig,
) -> tuple[npt.NDArray[np.int32], int]:
    """Labels (h, w) and number of the pieces of an image (h, w, 3) at `scale` of the reference's size."""
    log_depth = np.log(np.maximum(depth, 1e-9))
    middle = np.float32(np.median(log_depth[wanted])) if wanted.any() else np.float32(0)
    colour = np.asarray(image / np.float32(255), np.float32)
    features = np.empty((*wanted.shape, 4), np.float32)
    features[..., :3] = colour - np.float32(0.5)
    features[..., 3] = config.depth_weight * (log_depth - middle)
    return partition(
        features,
        visibility(colour, scale) ** 2,
        wanted,
        tile_px=max(1, round(config.max_side_px * scale)),
        min_area_px=max(1, round(config.min_area_px * scale**2)),
        max_error=config.max_error * scale**2,
        noise_variance=3 * config.noise**2,  # of three channels of colour
    )


def _place_on_surface(
    pointmap: Pointmap,
    centre: Array,  # (N, 2) pixels
    spread: Array,  # (N, 2, 2) covariance in the image, pixels squared
    inverse_depth: Array,  # (N,)
    normal: Array,  # (N, 3) camera frame, of any length
    colour: Array,  # (N, 3) in [0, 1]
    config: GaussianInitializationConfig,
) -> Gaussians:
    """Gaussians in the tangent planes of the surface at these pixels, with their covariances carried there."""
    K, T_world_camera = pointmap.K, pointmap.T_world_camera
    count = len(centre)
    focal = np.array([K[0, 0], K[1, 1]])
    ray = np.column_stack([(centre - K[:2, 2]) / focal, np.ones(count)])
    mean = ray / np.maximum(inverse_depth, 1e-9)[:, None]
    normal = _facing_normals(normal, ray)
    # On the plane n . X = d a pixel's point is ray * d / (n . ray); `steps` are its derivatives by u and by v.
    along_ray = (normal * ray).sum(1)
    depth = (normal * mean).sum(1) / along_ray
    steps = np.stack([np.eye(3)[axis] - ray * (normal[:, axis] / along_ray)[:, None] for axis in (0, 1)], 2)
    steps = steps * (depth[:, None] / focal)[:, None, :]
    first = steps[:, :, 0] / np.linalg.norm(steps[:, :, 0], axis=1, keepdims=True)
    second = np.cross(normal, first)
    in_plane = np.stack([first, second], 1) @ steps  # (N, 2, 2)
    shape: Array = in_plane @ spread @ in_plane.transpose(0, 2, 1)
    variances, axes = np.linalg.eigh(shape)
    extents = config.footprint * np.sqrt(np.maximum(variances, 1e-18))
    along: Array = first * axes[:, :1, 1] + second * axes[:, 1:, 1]
    rotation: Array = T_world_camera[:3, :3] @ np.stack([along, np.cross(normal, along), normal], 2)
    scales: Array = np.column_stack([extents[:, 1], extents[:, 0], config.thickness * extents[:, 0]])

    def tensor(array: Array) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).float()

    return Gaussians(
        means=tensor(mean @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]),
        quats=quat_from_matrix(tensor(rotation)),
        log_scales=tensor(np.log(scales)),
        logit_opacities=torch.full((count,), logit(config.opacity)),
        sh=tensor((colour - 0.5) / SH_C0)[:, None],
        source_frame=torch.full((count,), pointmap.frame_id, dtype=torch.int32),
    )


def _facing_normals(normal: Array, ray: Array) -> Array:
    """(N, 3) unit normals that face the camera, from `normal` (N, 3) of any length; `ray` (N, 3) goes to the surface.

    The direction to the camera stands in for a missing normal. A normal at more than MIN_COSINE's angle to the line of
    sight is turned back to it: Gaussians of a surface seen edge-on would be stretched along the line of sight.
    """
    direction = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = np.where(length > MIN_NORMAL_LENGTH, normal / np.maximum(length, 1e-9), -direction)
    cosine = -(unit * direction).sum(1, keepdims=True)
    sideways = unit + cosine * direction
    sideways *= np.sqrt(1 - MIN_COSINE**2) / np.maximum(np.linalg.norm(sideways, axis=1, keepdims=True), 1e-9)
    return np.where(cosine < MIN_COSINE, sideways - MIN_COSINE * direction, unit)


def initialize_gaussians(
    pointmaps: Sequence[Pointmap],
    images: Sequence[npt.NDArray[np.uint8]],
    config: GaussianInitializationConfig,
    max_gaussians: int | None = None,
) -> Gaussians:
    """The Gaussians of a scene that has not been optimised: every surface once, from its most confident view.

    `images` (h, w, 3) are those of the point maps. With `max_gaussians` the pieces become coarser, everywhere alike,
    until there are at most that many.
    """
    wanted = [
        ~covered & (pointmap.confidence >= config.min_confidence)
        for pointmap, covered in zip(pointmaps, find_redundant_pixels(pointmaps, config), strict=True)
    ]
    sure = find_consistent_pixels(pointmaps)
    for _ in range(ATTEMPTS):
        seeded = partial(_initialize_gaussians, config=config)
        gaussians = concatenate(map_parallel(seeded, pointmaps, images, wanted, sure))
        if max_gaussians is None or len(gaussians) <= max_gaussians:
            return gaussians
        config = _coarsen_config(config, len(gaussians) / max(max_gaussians, 1))
    assert max_gaussians is not None  # else the first was returned
    return gaussians.subset(torch.linspace(0, len(gaussians) - 1, max_gaussians).round().long())


def _coarsen_config(config: GaussianInitializationConfig, times: float) -> GaussianInitializationConfig:
    """The configuration that gives about `times` fewer pieces."""
    times = max(times, MIN_COARSENING)
    return msgspec.structs.replace(
        config,
        max_error=times**ERROR_EXPONENT * config.max_error,
        min_area_px=times * config.min_area_px,
        max_side_px=min(round(times**0.5 * config.max_side_px), REFERENCE_PX),  # a whole photograph
    )


# Isotropic Gaussians at points, each as wide as its neighbours are apart: how 3DGS and its successors start.

NUM_NEIGHBOURS = 3  # whose mean squared distance is a new Gaussian's variance, as in 3DGS
LONE_SPACING = 1e-2  # of fewer points than neighbours are asked for; the scene's median depth is 1
MIN_SQUARED_SPACING = 1e-14  # of points that coincide: a Gaussian needs an extent


def gaussians_at(
    points: npt.NDArray[np.float32],  # (N, 3) world
    rgb: npt.NDArray[np.float32],  # (N, 3) in [0, 1]
    source_frame: npt.NDArray[np.int32],  # (N,)
    opacity: float,
    neighbours: int = NUM_NEIGHBOURS,
) -> Gaussians:
    """An isotropic Gaussian of degree 0 at each point; its standard deviation is the `spacing` of the points there."""
    count = len(points)
    return Gaussians(
        means=torch.from_numpy(points),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(spacing(points, neighbours)))[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), logit(opacity)),
        sh=torch.from_numpy((rgb - 0.5) / np.float32(SH_C0))[:, None],
        source_frame=torch.from_numpy(source_frame),
    )


def spacing(points: npt.NDArray[np.float32], neighbours: int) -> npt.NDArray[np.float32]:
    """(N,) root mean squared distance from each of the points (N, 3) to its nearest `neighbours` other ones."""
    if len(points) <= neighbours:
        return np.full(len(points), LONE_SPACING, np.float32)
    distances, _ = KDTree(points).query(points, neighbours + 1, workers=-1)
    return np.sqrt(np.maximum((distances[:, 1:] ** 2).mean(1), MIN_SQUARED_SPACING)).astype(np.float32)


# Pixelwise seeding, a Gaussian a pixel: how InstantSplat and the paper start; our scenes are compared with it.


class PixelwiseConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pixelwise seeding, a Gaussian a pixel: how InstantSplat and the paper start; our scenes are compared with it."""

    down_sampling: GaussianInitializationConfig = GaussianInitializationConfig(
        max_footprint_ratio=1e9
    )  # equations 14 to 17 as they are written
    min_confidence: float = 0.05  # least confidence of stereo, in [0, 1]: pixels below get no Gaussian
    opacity: float = 0.1  # of a new Gaussian, as in 3DGS
    neighbours: int = NUM_NEIGHBOURS  # points whose mean squared distance is a new Gaussian's variance
    # What lies behind: nothing, as published; our far shell; our filled depths and the shell (MASt3R's have no holes).
    surroundings: Literal["none", "shell", "fill"] = "none"


def pixelwise_gaussians(
    pointmaps: Sequence[Pointmap],
    images: Sequence[npt.NDArray[np.uint8]],
    config: PixelwiseConfig,
    max_gaussians: int | None = None,
) -> Gaussians:
    """An isotropic Gaussian for each pixel whose depth is confident and that no more confident view covers.

    Of more than `max_gaussians` an even choice is kept; sizes then follow from the distances between those.
    """
    points, colours, frames = [], [], []
    redundant = find_redundant_pixels(pointmaps, config.down_sampling)
    for pointmap, image, covered in zip(pointmaps, images, redundant, strict=True):
        kept = ~covered & (pointmap.depth > 0) & (pointmap.confidence >= config.min_confidence)
        points.append(pointmap.points[kept])
        colours.append(image[kept].astype(np.float32) / 255.0)
        frames.append(np.full(int(kept.sum()), pointmap.frame_id, np.int32))
    means, rgb, source_frame = (np.concatenate(parts) for parts in (points, colours, frames))
    if max_gaussians is not None and len(means) > max_gaussians:
        chosen = np.linspace(0, len(means) - 1, max_gaussians).round().astype(np.int64)
        means, rgb, source_frame = means[chosen], rgb[chosen], source_frame[chosen]
    return gaussians_at(means, rgb, source_frame, config.opacity, config.neighbours)


Image = npt.NDArray[np.uint8]

SHELL_PARTS = 10  # with a limit on the Gaussians, one part in this many may be the far shell


class SceneInitializationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which Gaussians a scene begins with."""

    completion: scene_background.DepthCompletionConfig = scene_background.DepthCompletionConfig()
    initialization: GaussianInitializationConfig = GaussianInitializationConfig()
    background: scene_background.BackgroundConfig = scene_background.BackgroundConfig()
    pixelwise: PixelwiseConfig | None = None  # in place of seeding: a Gaussian a pixel that stereo knows
    max_gaussians: int | None = None  # None: as many as the photographs call for


def initialize_scene(
    pointmaps: Sequence[Pointmap],
    images: Mapping[str, Image],
    config: SceneInitializationConfig,
    masks: Mapping[str, Mask | None] = MappingProxyType({}),
    exposures: Mapping[str, Exposure] = MappingProxyType({}),
    lenses: Mapping[str, Intrinsics | None] = MappingProxyType({}),
) -> Scene:
    """The scene with a training view for each point map, and Gaussians seeded from all of them.

    `images` (h, w, 3) are found by the point maps' names. Pixels of a dark rim, which do not show the
    scene, seed nothing. Nor do those that `masks` (h, w) hide, of which the point maps know nothing; where no view
    sees behind them, the fill goes on there. `exposures`, and the distortion of `lenses`, were taken out of the
    images.
    """
    pictures = [images[pointmap.name] for pointmap in pointmaps]
    valid = keyframes.valid_masks(pictures)
    known_masks = [masks.get(pointmap.name) for pointmap in pointmaps]
    pointmaps = tuple(map(Pointmap.apply_image_mask, map(Pointmap.apply_mask, pointmaps, valid), known_masks))
    used = [rim if mask is None else rim & mask for rim, mask in zip(valid, known_masks, strict=True)]
    sure = find_consistent_pixels(pointmaps)
    shares = compute_consistent_shares(sure, used)
    usable = [each.apply_mask(each.confidence >= config.completion.min_usable_confidence) for each in pointmaps]
    surroundings = "fill" if config.pixelwise is None else config.pixelwise.surroundings
    shells = [] if surroundings == "none" else [_shell(usable, pictures, config)]
    limit = None if config.max_gaussians is None else config.max_gaussians - sum(map(len, shells))
    dense = pointmaps
    if surroundings == "fill":
        dense = list(
            map(Pointmap.apply_mask, scene_background.complete(usable, pictures, config.completion, known_masks), valid)
        )
    del usable
    if config.pixelwise is not None:
        surfaces = pixelwise_gaussians(dense, pictures, config.pixelwise, limit)
        return Scene(_views(dense, shares, images, masks, exposures, lenses), concatenate([surfaces, *shells]))
    surfaces = initialize_gaussians(dense, pictures, config.initialization)
    num_unlimited = len(surfaces) + sum(map(len, shells))
    if limit is not None and len(surfaces) > limit:
        surfaces = initialize_gaussians(dense, pictures, config.initialization, limit)
    return Scene(
        _views(pointmaps, shares, images, masks, exposures, lenses),
        concatenate([surfaces, *shells]),
        num_unlimited=num_unlimited,
    )


def _shell(pointmaps: Sequence[Pointmap], pictures: Sequence[Image], config: SceneInitializationConfig) -> Gaussians:
    limit = None if config.max_gaussians is None else config.max_gaussians // SHELL_PARTS
    return scene_background.far_shell(pointmaps, pictures, config.background, limit)


def _views(
    pointmaps: Sequence[Pointmap],
    shares: Sequence[float],
    images: Mapping[str, Image],
    masks: Mapping[str, Mask | None],
    exposures: Mapping[str, Exposure],
    lenses: Mapping[str, Intrinsics | None],
) -> tuple[TrainingView, ...]:
    return tuple(
        TrainingView(
            name=pointmap.name,
            frame_id=pointmap.frame_id,
            image=images[pointmap.name],
            T_world_camera=torch.tensor(pointmap.T_world_camera, dtype=torch.float32),
            K=torch.tensor(pointmap.K, dtype=torch.float32),
            pointmap=pointmap,
            mask=masks.get(pointmap.name),
            exposure=exposures.get(pointmap.name),
            lens=lenses.get(pointmap.name),
            consistent_depth=share,
        )
        for pointmap, share in zip(pointmaps, shares, strict=True)
    )


# The first look: Gaussians at the points that registration triangulated, before there is any depth.

OPACITY = 0.8  # of each Gaussian: there are few, and what is behind them is not known
MAX_GAUSSIANS = 20_000  # more points make the look slower and hardly better


def create_coarse_scene(graph: ViewGraph, registration: Registration, max_gaussians: int | None = None) -> Scene:
    """A coarse scene of the registered cameras: an isotropic Gaussian at each point, as wide as points are apart.

    Its colour is that of the photograph in which it was observed last. Of more than `max_gaussians`, or MAX_GAUSSIANS,
    an even choice is shown.
    """
    rgb = np.zeros((len(registration.points), 3), np.float32)
    source = np.full(len(registration.points), -1, np.int32)
    views = []
    for camera in registration.cameras:
        keyframe = graph.keyframes[camera.index]
        mine = registration.observed_by == camera.index
        height, width = keyframe.image.shape[:2]
        pixels = (registration.observed_pixels[mine] * keyframe.scale).astype(np.int64)
        x, y = np.clip(pixels, 0, [width - 1, height - 1]).T
        rgb[registration.observed_point[mine]] = keyframe.image[y, x] / np.float32(255)
        source[registration.observed_point[mine]] = keyframe.frame.frame_id
        T_world_camera = torch.tensor(camera.T_world_camera, dtype=torch.float32)
        K = torch.tensor(compute_modelled_K(graph, camera), dtype=torch.float32)
        shown = keyframe.name, keyframe.frame.frame_id, keyframe.image
        views.append(TrainingView(*shown, T_world_camera, K, mask=keyframe.mask, lens=keyframe.lens))
    seen = np.flatnonzero(source >= 0)
    most = min(len(seen), MAX_GAUSSIANS, max_gaussians or MAX_GAUSSIANS)
    chosen = seen[np.linspace(0, len(seen) - 1, most).round().astype(np.int64)]
    points = registration.points[chosen].astype(np.float32)
    return Scene(tuple(views), gaussians_at(points, rgb[chosen], source[chosen], OPACITY))
