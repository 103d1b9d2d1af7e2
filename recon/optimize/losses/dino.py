"""Image embeddings of DINOv2, the paper's semantic features (equation 12), with gradients."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor
from torch.nn import functional

from splatnode.recon.networks import weights
from splatnode.recon.networks.vit import PATCH, Dinov2, normalize_image
from splatnode.recon.networks.weights import locate_weights

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
    return weights.load_network(Dinov2, weights.read_weights(path), path, "DINOv2 ViT-S/14")
