"""Rotary position embedding in two dimensions ("RoPE", Su et al. 2021; base 100 for image patches, as CroCo v2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_BASE = 100.0


@dataclass(frozen=True, eq=False)
class Rotary:
    """The rotations of N positions: the first half of a vector turns with the row, the second with the column."""

    cosine: Tensor  # (N, D)
    sine: Tensor  # (N, D)

    @classmethod
    def create_from_positions(cls, positions: Tensor, dimension: int) -> Rotary:
        """For vectors of `dimension` D, a multiple of 4, at `positions` (N, 2) in patches."""
        quarter = dimension // 4
        frequencies = _BASE ** (-torch.arange(quarter, device=positions.device, dtype=torch.float32) / quarter)
        angles = positions.to(torch.float32)[:, :, None] * frequencies  # (N, 2, D / 4)
        angles = torch.cat([angles, angles], dim=-1).flatten(1)
        return cls(angles.cos(), angles.sin())

    def rotate(self, x: Tensor) -> Tensor:
        """(..., N, D) vectors, each turned by the rotation of its position."""
        first, second = x.unflatten(-1, (2, 2, -1)).unbind(-2)  # pairs lie a quarter of D apart
        across = torch.stack([-second, first], dim=-2).flatten(-3)
        return x * self.cosine + across * self.sine


def grid_positions(rows: int, columns: int) -> Tensor:
    """(rows * columns, 2) row and column of each patch, row by row."""
    return torch.cartesian_prod(torch.arange(rows), torch.arange(columns))
