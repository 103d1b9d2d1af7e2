"""The far shell: Gaussians on a sphere around the scene, so that what no view has seen has the colours around it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.recon.geometry import project, quat_from_matrix, transform_to_camera
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.result.sources import SHELL
from splatnode.recon.scene.gaussians import SH_C0, Gaussians, logit

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]

EXTENT = 0.7  # standard deviation of a Gaussian along the shell, over the spacing: neighbours overlap without seams
THICKNESS = 0.1  # standard deviation of a Gaussian across the shell, over that along it
MIN_COSINE = 0.05  # of a point's angle to the optical axis: beyond, 87 degrees, a pinhole's pixels run to infinity
BLUR = 0.04  # standard deviation of the colours' blur, over an image's longer side: the shell shows no detail
BLURRED_PX = 4  # pixels of a blurred image in a standard deviation of its blur: finer ones show nothing more
FAR_POWER = 4  # of a pixel's depth over the farthest, by which its colour counts: half as far is a sixteenth
MIN_FAR_WEIGHT = 1e-3  # of the nearest pixel, where no far one is in reach of the blur
OUTSIDE_PENALTY = 10.0  # by which the logarithm of a view's weight falls for each image size that a point lies outside
ELEVATION_STRETCH = 4.0  # by which differences of elevation count: what lies beside the images is more like them
MIN_SQUARED_DISTANCE = 1e-4  # between directions of length 1, in the weights of the continuation
MIN_WIDENING = 1.1  # of the spacing in each attempt to have fewer Gaussians


class BackgroundConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    spacing_deg: float = 5.0  # between neighbouring Gaussians of the shell; 0: there is no shell
    margin: float = 2.0  # how far beyond the images' borders they are so near, in units of the images' size
    elsewhere_deg: float = 10.0  # between those in all other directions; 0: there are none
    distance: float = 1.3  # radius, in units of the farthest known depth
    opacity: float = 0.95  # of the shell's Gaussians


def far_shell(
    pointmaps: Sequence[Pointmap], images: Sequence[Image], config: BackgroundConfig, max_gaussians: int | None = None
) -> Gaussians:
    """Gaussians on a sphere around the cameras, closer where these look than elsewhere; at most `max_gaussians`.

    `images` (h, w, 3) are those of the point maps. Where there would be more Gaussians, there are none elsewhere, and
    if that does not suffice the others are farther apart.
    """
    shell = _shell(pointmaps, images, config)
    if max_gaussians is not None and len(shell) > max_gaussians:
        config = msgspec.structs.replace(config, elsewhere_deg=0.0)
        shell = _shell(pointmaps, images, config)
    while max_gaussians is not None and len(shell) > max_gaussians:
        wider = max(MIN_WIDENING, (len(shell) / max(max_gaussians, 1)) ** 0.5)
        config = msgspec.structs.replace(config, spacing_deg=wider * config.spacing_deg)
        shell = _shell(pointmaps, images, config)
    return shell


def _shell(pointmaps: Sequence[Pointmap], images: Sequence[Image], config: BackgroundConfig) -> Gaussians:
    """Gaussians with the colours that the images have there, or suggest."""
    centres = np.stack([pointmap.T_world_camera[:3, 3] for pointmap in pointmaps])
    centre = centres.mean(0)
    farthest = max(1e-9, *(float(pointmap.depth.max()) for pointmap in pointmaps))  # no depth may be known anywhere
    spread = float(np.linalg.norm(centres - centre, axis=1).max())
    radius = config.distance * max(farthest, spread)
    fine = _fibonacci_sphere(config.spacing_deg)
    coarse = _fibonacci_sphere(config.elsewhere_deg if len(fine) else 0.0)
    directions = np.concatenate([fine, coarse])
    spacing_deg = np.repeat([config.spacing_deg, config.elsewhere_deg], [len(fine), len(coarse)])
    outside, colours = _sample_colours(centre + radius * directions, farthest, pointmaps, images)
    kept = (outside < config.margin) == (np.arange(len(directions)) < len(fine))
    directions, outside, colours, spacing_deg = directions[kept], outside[kept], colours[kept], spacing_deg[kept]
    inside = outside <= 0
    if inside.any():
        upward = -np.sum([pointmap.T_world_camera[:3, 1] for pointmap in pointmaps], axis=0)
        colours[~inside] = _extrapolate_colours(directions[~inside], directions[inside], colours[inside], upward)
    count = len(directions)
    scales = EXTENT * radius * np.radians(spacing_deg)[:, None] * np.array([1.0, 1.0, THICKNESS])
    return Gaussians(
        means=torch.from_numpy(centre + radius * directions).float(),
        quats=quat_from_matrix(torch.from_numpy(_frames(directions)).float()),
        log_scales=torch.from_numpy(np.log(scales)).float(),
        logit_opacities=torch.full((count,), logit(config.opacity)),
        sh=torch.from_numpy((colours - 0.5) / SH_C0).float()[:, None],
        source_frame=torch.full((count,), SHELL, dtype=torch.int32),
    )


def _sample_colours(
    points: Array, farthest: float, pointmaps: Sequence[Pointmap], images: Sequence[Image]
) -> tuple[Array, Array]:
    """(M,) how far world points (M, 3) lie outside all images, in units of the images' size; (M, 3) their colours.

    A point inside an image has a negative distance, one that no view has before it an infinite one. A colour is
    strongly blurred over what is far or unknown: a near wall says nothing about what lies behind it. It comes from the
    view that sees farthest in that direction, less so the farther outside its image the point lies.
    """
    outside = np.full(len(points), np.inf)
    best = np.full(len(points), -np.inf)
    colours = np.zeros((len(points), 3))
    for pointmap, image in zip(pointmaps, images, strict=True):
        height, width = image.shape[:2]
        in_camera = transform_to_camera(points, pointmap.T_world_camera)
        ahead = in_camera[:, 2] > MIN_COSINE * np.linalg.norm(in_camera, axis=1)
        pixels = project(in_camera, pointmap.K)
        relative = pixels / (width, height) - 0.5
        distance = np.where(ahead, np.abs(relative).max(1) - 0.5, np.inf)
        blurred, sees_far = _far_colours(image, pointmap.depth / farthest, BLUR * max(height, width))
        size = np.array([blurred.shape[1], blurred.shape[0]])
        column, row = np.clip(pixels * (size / (width, height)), 0, size - 1).astype(int).T
        score = np.log(sees_far[row, column]) - OUTSIDE_PENALTY * distance
        better = score > best
        colours[better], best[better] = blurred[row, column][better], score[better]
        outside = np.minimum(outside, distance)
    return outside, colours


def _extrapolate_colours(directions: Array, seen: Array, colours: Array, upward: Array) -> Array:
    """(M, 3) colours for unseen unit `directions` (M, 3), from the colours (N, 3) of directions `seen` (N, 3).

    Inverse distance weighting with the fourth power (Shepard 1968), elevation stretched by ELEVATION_STRETCH.
    `upward` (3,) is of any length.
    """
    upward = upward / max(float(np.linalg.norm(upward)), 1e-9)
    stretched = np.eye(3) + (ELEVATION_STRETCH - 1.0) * np.outer(upward, upward)
    squared = (((directions @ stretched)[:, None] - (seen @ stretched)[None]) ** 2).sum(2)
    nearness = 1.0 / (squared + MIN_SQUARED_DISTANCE) ** 2
    return nearness @ colours / nearness.sum(1, keepdims=True)


def _far_colours(image: Image, relative_depth: Float32, sigma_px: float) -> tuple[Float32, Float32]:
    """Colours (h', w', 3) in [0, 1] blurred over far and unknown pixels, and the weight (h', w') of these.

    `relative_depth` (h, w) is 1 at the farthest known depth and 0 where the depth is unknown. The result has
    BLURRED_PX pixels to a standard deviation `sigma_px` of the blur.
    """
    far = np.where(relative_depth > 0, relative_depth**FAR_POWER, np.float32(1)) + np.float32(MIN_FAR_WEIGHT)
    shrink = max(1.0, sigma_px / BLURRED_PX)
    size = (max(1, round(image.shape[1] / shrink)), max(1, round(image.shape[0] / shrink)))
    weighted = cv2.resize(image * (far / 255)[..., None], size, interpolation=cv2.INTER_AREA)
    sigma = sigma_px / shrink
    weight = cv2.GaussianBlur(cv2.resize(far, size, interpolation=cv2.INTER_AREA), (0, 0), sigma)
    blurred = cv2.GaussianBlur(weighted, (0, 0), sigma)
    return np.asarray(blurred / weight[..., None], np.float32), np.asarray(weight, np.float32)


def _fibonacci_sphere(spacing_deg: float) -> Array:
    """(M, 3) unit directions that cover the sphere evenly, on a Fibonacci lattice; none for a spacing of 0."""
    count = int(4 * np.pi / np.radians(spacing_deg) ** 2) if spacing_deg > 0 else 0
    step = np.arange(count) + 0.5
    z = 1.0 - 2.0 * step / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * step
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def _frames(directions: Array) -> Array:
    """(M, 3, 3) rotations whose third axis is each of the unit directions (M, 3)."""
    helper = np.where(np.abs(directions[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])  # far from parallel
    first: Array = np.cross(helper, directions)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first), directions], 2)
