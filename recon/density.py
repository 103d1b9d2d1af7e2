"""Where Gaussians start: the paper's confidence-ranked down-sampling, then one Gaussian per cell of image detail."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from recon.gaussians import SH_C0, Gaussians, concatenate
from recon.geometry import quat_from_matrix
from recon.priors import reprojection
from recon.priors.pointmap import Pointmap

Mask = npt.NDArray[np.bool_]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    depth_tolerance: float = 0.02  # theta of equation 16, relative to the depth
    coarser: float = 1.5  # a point replaces a pixel only if its own pixel covers at most this many times the surface
    min_confidence: float = 0.05  # pixels below get no Gaussian
    largest_cell_px: int = 16
    smallest_cell_px: int = 2
    colour_deviation: float = 0.035  # standard deviation of colour, in [0, 1], above which a cell is divided
    depth_deviation: float = 0.02  # standard deviation of depth, relative to it, above which a cell is divided
    footprint: float = 0.6  # standard deviation of a new Gaussian in units of its cell
    thickness: float = 0.15  # standard deviation along the normal, in units of that across
    opacity: float = 0.9

    def __post_init__(self) -> None:
        if self.smallest_cell_px < 1 or self.largest_cell_px not in _sizes(self):
            raise ValueError(
                "smallest_cell_px must be at least 1, and largest_cell_px that times a power of two, "
                f"got {self.smallest_cell_px} and {self.largest_cell_px}"
            )


def redundant(pointmaps: Sequence[Pointmap], config: Config) -> list[Mask]:
    """For each point map the pixels (h, w) that a more confident one already covers (equations 14 to 17).

    Beyond the paper, a pixel is not given up for a point that was seen from so much further away that detail is lost.
    """
    score = [float(pointmap.confidence.mean()) for pointmap in pointmaps]  # equation 14
    masks = []
    for j, target in enumerate(pointmaps):
        covered = np.zeros(target.depth.shape, bool)
        for i, source in enumerate(pointmaps):
            if (score[i], -i) > (score[j], -j):
                projected, footprint = reprojection.nearest(source, target)
                near = np.abs(projected - target.depth) < config.depth_tolerance * target.depth
                own = target.depth / target.K[0, 0]
                covered |= near & (footprint < config.coarser * own)
        masks.append(covered & (target.depth > 0))
    return masks


def gaussians_from_pointmap(
    pointmap: Pointmap, image: npt.NDArray[np.uint8], wanted: Mask, config: Config
) -> Gaussians:
    """One Gaussian per cell of a quadtree over the pixels `wanted` (h, w) of a keyframe's `image` (h, w, 3).

    A cell is divided while its colours or its depths vary, down to the smallest size; so plain surfaces take few large
    Gaussians and detail takes many small ones. Each lies on its cell's surface, turned to its normal.
    """
    height, width = pointmap.depth.shape
    size = config.largest_cell_px
    pad = ((0, -height % size), (0, -width % size))
    weight = np.pad((wanted & (pointmap.depth > 0)).astype(np.float32), pad)
    rows, columns = np.indices(weight.shape, np.float32) + np.float32(0.5)
    inverse_depth = np.where(pointmap.depth > 0, 1.0 / np.maximum(pointmap.depth, 1e-9), 0.0)
    inverse_depth = np.pad(inverse_depth.astype(np.float32), pad)
    colour = np.pad(image.astype(np.float32) / 255.0, (*pad, (0, 0)))
    normal = np.pad(pointmap.normal.astype(np.float32), (*pad, (0, 0)))
    values = np.concatenate(
        [np.stack([columns, rows, inverse_depth, inverse_depth**2], -1), colour, colour**2, normal], -1
    )
    values = np.concatenate([values * weight[..., None], weight[..., None]], -1)
    undecided = np.ones((weight.shape[0] // size, weight.shape[1] // size), bool)
    cells, sizes = [], []
    # Sums over the smallest cells; those over larger ones are sums of four.
    pyramid = {config.smallest_cell_px: _block_sums(values.astype(np.float64), config.smallest_cell_px)}
    for level in _sizes(config)[1:]:
        pyramid[level] = _block_sums(pyramid[level // 2], 2)
    while True:
        blocks = pyramid[size]
        count = blocks[..., -1]
        mean = blocks / np.maximum(count, 1.0)[..., None]
        deviation = np.sqrt(np.maximum(mean[..., 7:10] - mean[..., 4:7] ** 2, 0.0)).max(-1)
        relative_depth = np.sqrt(np.maximum(mean[..., 3] - mean[..., 2] ** 2, 0.0)) / np.maximum(mean[..., 2], 1e-9)
        partial = (count > 0) & (count < 0.75 * size * size)
        divide = (deviation > config.colour_deviation) | (relative_depth > config.depth_deviation) | partial
        leaf = undecided & (count > 0) & (~divide if size > config.smallest_cell_px else True)
        cells.append(mean[leaf])
        sizes.append(np.full(int(leaf.sum()), float(size)))
        if size <= config.smallest_cell_px:
            break
        undecided = np.repeat(np.repeat(undecided & divide & (count > 0), 2, 0), 2, 1)
        size //= 2
    return _on_surface(pointmap, np.concatenate(cells), np.concatenate(sizes), config)


def _sizes(config: Config) -> list[int]:
    sizes = [config.smallest_cell_px]
    while sizes[-1] < config.largest_cell_px:
        sizes.append(2 * sizes[-1])
    return sizes


def _block_sums(values: npt.NDArray[np.float64], size: int) -> npt.NDArray[np.float64]:
    """Sums over blocks of size x size of values (h, w, n)."""
    height, width, channels = values.shape
    return values.reshape(height // size, size, width // size, size, channels).sum((1, 3))


def _on_surface(
    pointmap: Pointmap, cells: npt.NDArray[np.float64], sizes: npt.NDArray[np.float64], config: Config
) -> Gaussians:
    """Gaussians from cell means: columns u, v, inverse depth, its square, rgb, rgb squared, normal, count."""
    K, T_world_camera = pointmap.K, pointmap.T_world_camera
    depth = 1.0 / np.maximum(cells[:, 2], 1e-9)
    ray = np.column_stack([(cells[:, 0] - K[0, 2]) / K[0, 0], (cells[:, 1] - K[1, 2]) / K[1, 1], np.ones(len(cells))])
    direction = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    normal = cells[:, 10:13]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0.3, normal / np.maximum(length, 1e-9), -direction)
    cosine = np.clip(-(normal * direction).sum(1), 0.25, 1.0)
    # In the tangent plane: one axis across the line of sight, the other, foreshortened in the image, along it.
    helper = np.where(np.abs(direction[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    slanted = np.cross(normal, direction)
    across = np.where(np.linalg.norm(slanted, axis=1, keepdims=True) > 0.05, slanted, np.cross(normal, helper))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(across, normal)
    rotation = T_world_camera[:3, :3] @ np.stack([along, across, normal], 2)
    extent = config.footprint * sizes * depth / K[0, 0]
    scales = np.column_stack([extent / cosine, extent, config.thickness * extent])
    means = (ray * depth[:, None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]

    def tensor(array: npt.NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).float()

    logit = float(np.log(config.opacity / (1 - config.opacity)))
    return Gaussians(
        means=tensor(means),
        quats=quat_from_matrix(tensor(rotation)),
        log_scales=tensor(np.log(scales)),
        logit_opacities=torch.full((len(cells),), logit),
        sh=tensor((cells[:, 4:7] - 0.5) / SH_C0)[:, None],
        source_frame=torch.full((len(cells),), pointmap.frame_id, dtype=torch.int32),
    )


def initial_gaussians(
    pointmaps: Sequence[Pointmap],
    images: Sequence[npt.NDArray[np.uint8]],
    config: Config,
    max_gaussians: int | None = None,
) -> Gaussians:
    """The Gaussians of a scene that has not been optimised: every surface once, from its best view.

    With `max_gaussians` cells are coarsened, everywhere alike, until there are at most that many.
    """
    wanted = [
        ~covered & (pointmap.confidence >= config.min_confidence)
        for pointmap, covered in zip(pointmaps, redundant(pointmaps, config), strict=True)
    ]
    while True:
        gaussians = concatenate(
            [gaussians_from_pointmap(*view, config) for view in zip(pointmaps, images, wanted, strict=True)]
        )
        if max_gaussians is None or len(gaussians) <= max_gaussians:
            return gaussians
        if config.smallest_cell_px >= 64:
            keep = torch.linspace(0, len(gaussians) - 1, max_gaussians).round().long()
            return gaussians.subset(keep)
        config = _coarser(config)


def _coarser(config: Config) -> Config:
    """More deviation allowed in a cell; once that is beyond all contrast, larger cells."""
    if config.colour_deviation < 0.25:
        return msgspec.structs.replace(
            config, colour_deviation=1.4 * config.colour_deviation, depth_deviation=1.4 * config.depth_deviation
        )
    smallest = 2 * config.smallest_cell_px
    return msgspec.structs.replace(
        config, smallest_cell_px=smallest, largest_cell_px=max(smallest, config.largest_cell_px)
    )
