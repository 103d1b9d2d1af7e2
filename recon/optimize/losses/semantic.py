"""Semantic regularisation: a pseudo view shows the same place as the photograph nearest to it (equation 12).

It needs an embedding that tells places apart, as DINOv2's. Averaged features of LPIPS in its stead were measured:
neighbouring photographs are .2 apart in them, their gradient with respect to the pixels was 30 times that of the
photometric loss, and sceaux lost .03 SSIM and .1 LPIPS.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from splatnode.recon import networks
from splatnode.recon.networks import locate_weights
from splatnode.recon.networks.vit import PATCH, Dinov2, normalize_image
from splatnode.recon.optimize.losses import Loss, Schedule
from splatnode.recon.optimize.regularizers import Supervision
from splatnode.recon.rasterize.reference import Render

# Image embeddings of DINOv2, the paper's semantic features (equation 12), with gradients.

WEIGHTS = "dinov2/dinov2_vits14_pretrain.pth"


@dataclass(frozen=True, eq=False)
class DinoFeatures:
    """A `recon.optimize.losses.semantic.Encoder`: the class token after the last block."""

    network: Dinov2
    longer_side: int = 224  # pixels, as in its training
    name: str = "DINOv2 ViT-S/14"

    def __call__(self, image: Tensor) -> Tensor:
        """(D,) of unit length, of an image (H, W, 3) in [0, 1]."""
        scale = self.longer_side / max(image.shape[:2])
        size = [max(1, round(side * scale / PATCH)) * PATCH for side in image.shape[:2]]
        resized = functional.interpolate(
            normalize_image(image)[None], size=size, mode="bilinear", antialias=True, align_corners=False
        )
        (tokens,) = self.network(resized, (len(self.network.blocks) - 1,))
        return functional.normalize(tokens[0, 0], dim=0)


def load_dino() -> DinoFeatures | None:
    """None without weights. Raises ValueError where they are of another model."""
    path = locate_weights(WEIGHTS)
    return None if path is None else DinoFeatures(load_network(path))


def load_network(path: Path) -> Dinov2:
    """Raises ValueError where the file is damaged, holds another model or anything but data, and FileNotFoundError."""
    return networks.load_network(Dinov2, networks.read_weights(path), path, "DINOv2 ViT-S/14")


class Config(Schedule, frozen=True, forbid_unknown_fields=True):
    """The semantic loss has no settings of its own."""


class Encoder(Protocol):
    @property
    def name(self) -> str: ...

    def __call__(self, image: Tensor) -> Tensor:
        """(D,) embedding of unit length of an image (H, W, 3) in [0, 1], with gradients."""
        ...


def prepare(config: Config, supervision: Supervision, seed: int) -> Loss:
    """The semantic loss on pseudo views; none without DINOv2's weights, for which nothing serves instead."""
    encode: Encoder | None = load_dino()
    if encode is None:
        return Loss("nothing: no weights")
    with torch.no_grad():
        embeddings = [encode(_unit(image)) for image in supervision.images]
    nearest = [view.nearest for view in supervision.pseudo_views]

    def evaluate_pseudo_view(index: int, render: Render) -> Tensor:
        assert render.rgb is not None  # it was asked for
        return semantic_loss(encode(render.rgb), embeddings[nearest[index]])

    return Loss(encode.name, on_pseudo_view=evaluate_pseudo_view)


def semantic_loss(embedding: Tensor, truth: Tensor) -> Tensor:
    """Squared distance of two embeddings (D,); 0 for equal ones."""
    if embedding.shape != truth.shape or embedding.dim() != 1:
        raise ValueError(f"embeddings must both be (D,), got {tuple(embedding.shape)} and {tuple(truth.shape)}")
    return torch.sum((embedding - truth) ** 2)


def _unit(image: npt.NDArray[np.uint8]) -> Tensor:
    """(H, W, 3) in [0, 1]."""
    return torch.from_numpy(image).float() / 255.0
