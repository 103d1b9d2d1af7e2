"""Semantic regularisation: what is seen from a new viewpoint is still the same place (equation 12)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from recon.losses.dino import load_dino
from recon.losses.lpips import Lpips, load_lpips


class Encoder(Protocol):
    @property
    def name(self) -> str: ...

    def __call__(self, image: Tensor) -> Tensor:
        """(D,) embedding of unit length of an image (H, W, 3) in [0, 1], with gradients."""
        ...


@dataclass(frozen=True, eq=False)
class PooledFeatures:
    """The deepest features of the LPIPS network, averaged over the image: what is seen, not where."""

    network: Lpips
    name: str = "LPIPS AlexNet features, pooled"

    def __call__(self, image: Tensor) -> Tensor:
        return functional.normalize(self.network.features(image)[-1].mean((0, 2, 3)), dim=0)


def load_encoder() -> Encoder | None:
    """DINOv2, as in the paper, else the features of LPIPS; None without weights of either."""
    dino = load_dino()
    if dino is not None:
        return dino
    network = load_lpips("alex")
    return None if network is None else PooledFeatures(network)


def semantic_loss(embedding: Tensor, truth: Tensor) -> Tensor:
    """Squared distance of two embeddings (D,); 0 for equal ones."""
    if embedding.shape != truth.shape or embedding.dim() != 1:
        raise ValueError(f"embeddings must both be (D,), got {tuple(embedding.shape)} and {tuple(truth.shape)}")
    return torch.sum((embedding - truth) ** 2)
