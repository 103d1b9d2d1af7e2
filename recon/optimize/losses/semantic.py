"""Semantic regularisation: what is seen from a new viewpoint is still the same place (equation 12).

Only a network that was taught what a place is serves. Features of LPIPS, averaged over the image, were measured in its
stead: neighbouring photographs are .2 apart in them, their gradient with respect to the pixels was 30 times the
photographs', and sceaux lost .03 SSIM and .1 LPIPS.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor


class Encoder(Protocol):
    @property
    def name(self) -> str: ...

    def __call__(self, image: Tensor) -> Tensor:
        """(D,) embedding of unit length of an image (H, W, 3) in [0, 1], with gradients."""
        ...


def semantic_loss(embedding: Tensor, truth: Tensor) -> Tensor:
    """Squared distance of two embeddings (D,); 0 for equal ones."""
    if embedding.shape != truth.shape or embedding.dim() != 1:
        raise ValueError(f"embeddings must both be (D,), got {tuple(embedding.shape)} and {tuple(truth.shape)}")
    return torch.sum((embedding - truth) ** 2)
