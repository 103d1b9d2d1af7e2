"""Seeding: the paper's confidence-ranked down-sampling, then one Gaussian for each piece of equal colour and depth.

A piece is as large as its error allows (`partition`), with the same visible error everywhere (`contrast_masking`): that
is the best use of a number of Gaussians. Errors are measured in photographs of a fixed size, so that the number of
Gaussians follows from what there is to see and not from how many pixels show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.recon.geometry import quat_from_matrix
from splatnode.recon.priors import reprojection
from splatnode.recon.priors.confirmed import find_consistent_pixels
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.result.sources import encode_unconfirmed
from splatnode.recon.scene.contrast_masking import visibility
from splatnode.recon.scene.gaussians import SH_C0, Gaussians, concatenate, logit
from splatnode.recon.scene.partition import partition
from splatnode.recon.workers import map_parallel

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
    depth_tolerance: float = 0.02  # theta of equation 16, relative to the depth
    max_footprint_ratio: float = 1.5  # a pixel is redundant only beside a point whose footprint is at most this larger
    min_confidence: float = 0.05  # least confidence of stereo, in [0, 1]: pixels below get no Gaussian
    max_side_px: int = 64  # side of the squares of a grid that no piece reaches across
    min_area_px: float = 3.0  # pieces of at most this area are not cut
    # Largest error of a piece: squared visible deviation of colours in [0, 1], over pixels and channels
    max_error: float = 0.0021
    depth_weight: float = 1.0  # a relative difference of depth counts as this many times a difference of colour
    noise: float = 0.01  # standard deviation of colours in [0, 1] that is not worth a Gaussian
    footprint: float = 1.2  # standard deviations of a new Gaussian across, over its piece's
    thickness: float = 1.0  # its standard deviation along the normal, over the smaller one across
    opacity: float = 0.5  # of a new Gaussian


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
                projected, footprint = reprojection.project_nearest(pointmaps[i], target)
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
