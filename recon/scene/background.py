"""A far shell behind the scene, so that what no view has seen is not black but of the colour around it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.recon.geometry import quat_from_matrix
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.scene.gaussians import SH_C0, Gaussians

Array = npt.NDArray[np.float64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    spacing_deg: float = 5.0  # between neighbouring Gaussians of the shell; 0 leaves it out
    margin: float = 2.0  # how far beyond the images' borders it reaches, in units of their size
    distance: float = 1.3  # from the cameras, in units of the farthest known depth
    opacity: float = 0.95


SHELL = -1  # the source_frame of its Gaussians, which no frame's pixels started


def background(
    pointmaps: Sequence[Pointmap],
    images: Sequence[npt.NDArray[np.uint8]],
    config: Config,
    max_gaussians: int | None = None,
) -> Gaussians:
    """Gaussians on a sphere around the cameras, in the directions that they look; wider apart to be `max_gaussians`."""
    shell = _shell(pointmaps, images, config)
    while max_gaussians is not None and len(shell) > max_gaussians:
        wider = max(1.1, (len(shell) / max(max_gaussians, 1)) ** 0.5)
        config = msgspec.structs.replace(config, spacing_deg=wider * config.spacing_deg)
        shell = _shell(pointmaps, images, config)
    return shell


def _shell(pointmaps: Sequence[Pointmap], images: Sequence[npt.NDArray[np.uint8]], config: Config) -> Gaussians:
    """The Gaussians `config.spacing_deg` apart, with the colours that the images have there or suggest."""
    centres = np.stack([pointmap.T_world_camera[:3, 3] for pointmap in pointmaps])
    centre = centres.mean(0)
    farthest = max(float(pointmap.depth.max()) for pointmap in pointmaps)
    spread = float(np.linalg.norm(centres - centre, axis=1).max())
    radius = config.distance * max(farthest, spread)
    directions = _sphere(config.spacing_deg)
    outside, colours = _seen(centre + radius * directions, farthest, pointmaps, images)
    kept = outside < config.margin
    directions, outside, colours = directions[kept], outside[kept], colours[kept]
    inside = outside <= 0
    if inside.any():
        upward = -np.sum([pointmap.T_world_camera[:3, 1] for pointmap in pointmaps], axis=0)
        colours[~inside] = _continued(directions[~inside], directions[inside], colours[inside], upward)
    count = len(directions)
    extent = 0.7 * radius * np.radians(config.spacing_deg)
    scales = np.tile(extent * np.array([1.0, 1.0, 0.1]), (count, 1))
    return Gaussians(
        means=torch.from_numpy(centre + radius * directions).float(),
        quats=quat_from_matrix(torch.from_numpy(_frames(directions)).float()),
        log_scales=torch.from_numpy(np.log(scales)).float(),
        logit_opacities=torch.full((count,), float(np.log(config.opacity / (1 - config.opacity)))),
        sh=torch.from_numpy((colours - 0.5) / SH_C0).float()[:, None],
        source_frame=torch.full((count,), SHELL, dtype=torch.int32),
    )


def _seen(
    points: Array, farthest: float, pointmaps: Sequence[Pointmap], images: Sequence[npt.NDArray[np.uint8]]
) -> tuple[Array, Array]:
    """How far outside all images the points (M, 3) lie, in units of the images' size, and their colours (M, 3) there.

    A colour is strongly blurred over what is far or unknown: a wall that is near says nothing about what lies behind
    it. Views that see far in that direction count, and of these the one that the point lies deepest in.
    """
    outside = np.full(len(points), np.inf)
    best = np.full(len(points), -np.inf)
    colours = np.zeros((len(points), 3))
    for pointmap, image in zip(pointmaps, images, strict=True):
        height, width = image.shape[:2]
        in_camera = (points - pointmap.T_world_camera[:3, 3]) @ pointmap.T_world_camera[:3, :3]
        ahead = in_camera[:, 2] > 0.05 * np.linalg.norm(in_camera, axis=1)
        pixels = in_camera[:, :2] / np.where(ahead, in_camera[:, 2], 1.0)[:, None] * np.diag(pointmap.K)[:2]
        pixels += pointmap.K[:2, 2]
        relative = pixels / (width, height) - 0.5
        distance = np.where(ahead, np.abs(relative).max(1) - 0.5, np.inf)
        blurred, sees_far = _far_colours(image, pointmap.depth / farthest, 0.04 * max(height, width))
        size = np.array([blurred.shape[1], blurred.shape[0]])
        column, row = np.clip(pixels * (size / (width, height)), 0, size - 1).astype(int).T
        score = np.log(sees_far[row, column]) - 10.0 * distance
        better = score > best
        colours[better], best[better] = blurred[row, column][better], score[better]
        outside = np.minimum(outside, distance)
    return outside, colours


def _continued(directions: Array, seen: Array, colours: Array, upward: Array) -> Array:
    """(M, 3) for unseen directions (M, 3) the mean of the colours (N, 3) of directions that are `seen` (N, 3).

    Each counts by the fourth power of its nearness (Shepard, 1968). A difference of elevation counts fourfold: what
    lies beside the images is more likely like them than what lies above or below.
    """
    upward = upward / max(float(np.linalg.norm(upward)), 1e-9)
    stretched = np.eye(3) + 3.0 * np.outer(upward, upward)
    squared = (((directions @ stretched)[:, None] - (seen @ stretched)[None]) ** 2).sum(2)
    nearness = 1.0 / (squared + 1e-4) ** 2
    return nearness @ colours / nearness.sum(1, keepdims=True)


def _far_colours(
    image: npt.NDArray[np.uint8], relative_depth: npt.NDArray[np.float32], sigma_px: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Colours (h', w', 3) in [0, 1] blurred over far and unknown pixels, and the weight (h', w') of these around.

    `relative_depth` is 1 at the farthest known depth and 0 where the depth is unknown. The blur leaves nothing finer
    than a quarter of `sigma_px`, so that is the size of the result's pixels.
    """
    far = np.where(relative_depth > 0, relative_depth**4, np.float32(1)) + np.float32(1e-3)
    shrink = max(1.0, sigma_px / 4)
    size = (max(1, round(image.shape[1] / shrink)), max(1, round(image.shape[0] / shrink)))
    weighted = cv2.resize(image * (far / 255)[..., None], size, interpolation=cv2.INTER_AREA)
    sigma = sigma_px / shrink
    weight = cv2.GaussianBlur(cv2.resize(far, size, interpolation=cv2.INTER_AREA), (0, 0), sigma)
    blurred = cv2.GaussianBlur(weighted, (0, 0), sigma)
    return np.asarray(blurred / weight[..., None], np.float32), np.asarray(weight, np.float32)


def _sphere(spacing_deg: float) -> Array:
    """(M, 3) directions that cover the sphere evenly (Fibonacci lattice); none for a spacing of 0."""
    count = int(4 * np.pi / np.radians(spacing_deg) ** 2) if spacing_deg > 0 else 0
    step = np.arange(count) + 0.5
    z = 1.0 - 2.0 * step / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * step
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def _frames(directions: Array) -> Array:
    """(M, 3, 3) rotations whose third axis points along each direction."""
    helper = np.where(np.abs(directions[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first: Array = np.cross(helper, directions)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first), directions], 2)
