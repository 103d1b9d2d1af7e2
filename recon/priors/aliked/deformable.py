"""Deformable sampling: a convolution and a descriptor whose samples are shifted by what they see."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def sample_maps(maps: Tensor, positions: Tensor) -> Tensor:
    """(C, ...): maps (C, H, W) at positions (..., 2), x and y in pixels from the first one's centre; 0 outside."""
    size = positions.new_tensor([maps.shape[2], maps.shape[1]])
    grid = ((2.0 * positions + 1.0) / size - 1.0).reshape(1, 1, -1, 2)
    found = F.grid_sample(maps[None], grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return found.reshape(len(maps), *positions.shape[:-1])


def make_window(size: int) -> Tensor:
    """(size * size, 2): x and y of a window's pixels from its middle, row by row."""
    steps = torch.arange(size) - size // 2
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2)


def _clamp_shifts(shifts: Tensor, height: int, width: int) -> Tensor:
    """Shifts that reach over at most a quarter of the longer side, as in training."""
    most = max(height, width) / 4.0
    return shifts.clamp(-most, most)


class DeformableConv(nn.Module):
    """A 3 x 3 convolution, each of whose nine samples is shifted (Dai et al. 2017, equation 2). Zero outside."""

    SIZE = 3

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__()
        self.offset_conv = nn.Conv2d(channels, 2 * self.SIZE**2, self.SIZE, padding=1)
        self.regular_conv = nn.Conv2d(channels, out_channels, self.SIZE, padding=1, bias=False)

    def forward(self, maps: Tensor) -> Tensor:
        """(1, C, H, W) to (1, C', H, W)."""
        height, width = maps.shape[2:]
        shifts = _clamp_shifts(self.offset_conv(maps)[0], height, width)
        shifts = shifts.reshape(-1, 2, height, width).permute(0, 2, 3, 1).flip(-1)  # y comes first
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        unshifted = torch.stack([x, y], -1) + make_window(self.SIZE)[:, None, None]  # (9, H, W, 2)
        samples = sample_maps(maps[0], unshifted + shifts)
        weight = self.regular_conv.weight
        return torch.einsum("ocs,cshw->ohw", weight.flatten(2), samples)[None]


class DeformableDescriptor(nn.Module):
    """The sparse deformable descriptor head (section III-C): sixteen samples around a keypoint, placed by its patch."""

    SIZE, SAMPLES = 3, 16

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.offset_conv = nn.Sequential(
            nn.Conv2d(channels, 2 * self.SAMPLES, self.SIZE),
            nn.SELU(),
            nn.Conv2d(2 * self.SAMPLES, 2 * self.SAMPLES, 1),
        )
        self.sf_conv = nn.Conv2d(channels, channels, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.empty(self.SAMPLES, channels, channels))

    def forward(self, features: Tensor, positions: Tensor) -> Tensor:
        """(M, C) descriptors of unit length: features (C, H, W) at positions (M, 2) in pixels from the first one's."""
        height, width = features.shape[1:]
        patches = sample_maps(features, positions.floor()[:, None] + make_window(self.SIZE).to(positions))
        patches = patches.permute(1, 0, 2).reshape(len(positions), -1, self.SIZE, self.SIZE)
        shifts = _clamp_shifts(self.offset_conv(patches), height, width).reshape(
            -1, 2, self.SAMPLES
        )  # all x, then all y
        samples = sample_maps(features, positions[:, None] + shifts.transpose(1, 2))
        seen = F.selu(self.sf_conv(samples[None])[0])
        return F.normalize(torch.einsum("cms,scd->md", seen, self.agg_weights), dim=1)
