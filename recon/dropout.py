"""Gaussians left out at random while they are fitted, so that none relies on what stands before or behind it.

From few photographs, Gaussians along a line of sight share a pixel's colour between them in a way that no other view
confirms. When any may be missing each must be right by itself (DropGaussian, Park et al. 2025).
"""

from __future__ import annotations

import msgspec
import torch
from torch import Tensor

MOST_OPACITY = 0.9999


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    share: float = 0.0  # of the Gaussians, left out of a render; 0: none
    until: float = 0.7  # part of the refinement; after it all are there, and sharpen what they show together


class Dropout:
    """Draws what each render leaves out."""

    def __init__(self, config: Config, seed: int) -> None:
        if not 0 <= config.share < 1:
            raise ValueError(f"dropout.share must be from 0 to below 1, got {config.share}")
        self._config = config
        self._generator = torch.Generator().manual_seed(seed)

    def __call__(self, opacities: Tensor, progress: float) -> Tensor:
        """The opacities (N,) of a render at `progress` in [0, 1]: 0, or larger by as much as others are missing."""
        share = self._config.share
        if share == 0 or progress >= self._config.until:
            return opacities
        there = torch.rand(len(opacities), generator=self._generator) >= share
        return (opacities * (there / (1 - share))).clamp(max=MOST_OPACITY)
