"""Where features are looked up: at a pixel's neighbours, and where a depth puts it in another photograph.

Pixel centres are at whole numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True, eq=False)
class Source:
    """A photograph with its camera."""

    image: Tensor  # (3, H, W) in [0, 1], sides multiples of 8
    K: Tensor  # (3, 3), the centre of the first pixel at (0, 0)
    T_camera_world: Tensor  # (4, 4)


def make_square_steps(reach: int, centre: bool = False) -> list[tuple[int, int]]:
    """(down, right) steps to the eight neighbours `reach` pixels away, row by row, with the middle or without."""
    steps = [(down, right) for down in (-reach, 0, reach) for right in (-reach, 0, reach)]
    return [step for step in steps if centre or step != (0, 0)]


def make_sampling_grid(learnt: Tensor, steps: Sequence[tuple[int, int]]) -> Tensor:
    """(M, h, w, 2) where to sample for M neighbours: a fixed step and a `learnt` one (2 M, h, w; x then y)."""
    height, width = learnt.shape[1:]
    rows, columns = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    x = torch.stack([columns + right for _, right in steps]) + learnt[0::2]
    y = torch.stack([rows + down for down, _ in steps]) + learnt[1::2]
    return torch.stack([x / ((width - 1) / 2) - 1, y / ((height - 1) / 2) - 1], -1)


def sample_neighbours(images: Tensor, grid: Tensor) -> Tensor:
    """(C, M, h, w) of images (C, h, w) at the M neighbours of every pixel."""
    count, height, width, _ = grid.shape
    flat = grid.reshape(1, count * height, width, 2)
    sampled = functional.grid_sample(images[None], flat, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled[0].unflatten(1, (count, height))


def compute_warp(reference: Source, source: Source, level: int) -> tuple[Tensor, Tensor]:
    """Rotation-like (3, 3) and translation (3,) that carry (x, y, 1) * depth of the reference into the source."""
    scale = torch.diag(torch.tensor([0.5**level, 0.5**level, 1.0], dtype=torch.float64))
    K_reference, K_source = scale @ reference.K.double(), scale @ source.K.double()
    motion = source.T_camera_world.double() @ torch.linalg.inv(reference.T_camera_world.double())
    return (
        (K_source @ motion[:3, :3] @ torch.linalg.inv(K_reference)).float(),
        (K_source @ motion[:3, 3]).float(),
    )


def warp_features(features: Tensor, warp: tuple[Tensor, Tensor], depths: Tensor) -> Tensor:
    """(C, D, h, w): the source's features (C, h', w') where the reference's pixels lie at `depths` (D, h, w)."""
    count, height, width = depths.shape
    rows, columns = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)])
    rays = torch.einsum("ij,jhw->ihw", warp[0], pixels)
    projected = rays[:, None] * depths[None] + warp[1].view(3, 1, 1, 1)
    behind = projected[2] <= 1e-3
    z = torch.where(behind, 1.0, projected[2])
    x = torch.where(behind, float(width), projected[0]) / z
    y = torch.where(behind, float(height), projected[1]) / z
    there_height, there_width = features.shape[1:]
    grid = torch.stack([x / ((there_width - 1) / 2) - 1, y / ((there_height - 1) / 2) - 1], -1)
    flat = grid.reshape(1, count * height, width, 2)
    sampled = functional.grid_sample(features[None], flat, mode="bilinear", padding_mode="zeros", align_corners=True)
    return sampled[0].unflatten(1, (count, height))
