"""A radiance field: density and colour of every point, by a small network (Mildenhall et al. 2020)."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

POINT_OCTAVES, DIRECTION_OCTAVES = 7, 2
_NEAREST_Z = 0.1  # points beside or behind the first camera are taken for as near as this


class Field(nn.Module):
    """(M, 3) points of the world and unit directions -> (M,) density and (M, 3) colour.

    Points are given to the network as the first camera sees them, x / z, y / z and 1 / z, which are the normalised
    device coordinates of forward-facing scenes but for constants.
    """

    def __init__(self, width: int = 64, layers: int = 3) -> None:
        super().__init__()
        sizes = [3 + 6 * POINT_OCTAVES, *[width] * layers]
        self.hidden = nn.ModuleList(nn.Linear(*size) for size in pairwise(sizes))
        self.density = nn.Linear(width, 1)
        self.colour = nn.Sequential(
            nn.Linear(width + 3 + 6 * DIRECTION_OCTAVES, width // 2), nn.ReLU(), nn.Linear(width // 2, 3), nn.Sigmoid()
        )

    def forward(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        z = points[:, 2:].clamp_min(_NEAREST_Z)
        features = encode_frequencies(torch.cat([points[:, :2] / z, 1 / z], 1), POINT_OCTAVES)
        for layer in self.hidden:
            features = functional.relu(layer(features))
        density = functional.softplus(self.density(features)[:, 0])
        return density, self.colour(torch.cat([features, encode_frequencies(directions, DIRECTION_OCTAVES)], 1))


def encode_frequencies(x: Tensor, octaves: int) -> Tensor:
    """(M, D + 2 D octaves) x (M, D) with its sines and cosines at frequencies of pi / 2, pi, 2 pi, ..."""
    scaled = x[:, None] * (2.0 ** torch.arange(-1, octaves - 1, dtype=x.dtype, device=x.device) * math.pi)[:, None]
    return torch.cat([x, scaled.sin().flatten(1), scaled.cos().flatten(1)], 1)
