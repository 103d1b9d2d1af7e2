"""DINOv2's vision transformer (Oquab et al. 2023), which several networks look through.

Written from the paper; modules carry the names of the official checkpoints.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatnode.recon.networks.transformer import Block, PatchEmbedding

PATCH = 14
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the images that it was trained with


@dataclass(frozen=True)
class Size:
    """The defaults are those of the published ViT-Small."""

    width: int = 384
    depth: int = 12
    heads: int = 6
    grid: int = 37  # patches along a side of the images that its positions were learned with


SMALL = Size()


class Dinov2(nn.Module):
    """The vision transformer: photographs in, tokens of their patches after chosen blocks out."""

    def __init__(self, size: Size = SMALL, *, masks: bool = True, normed_from: int | None = None) -> None:
        """`masks`: whether the checkpoint holds the pre-training's token. Blocks from `normed_from` on are normed."""
        super().__init__()
        self.size = size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, size.width))
        if masks:
            self.mask_token = nn.Parameter(torch.zeros(1, size.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + size.grid**2, size.width))
        self.patch_embed = PatchEmbedding(PATCH, size.width)
        first_normed = size.depth if normed_from is None else normed_from
        self.blocks = nn.ModuleList(
            Block(size.width, size.heads, scaled=True, normed=index >= first_normed) for index in range(size.depth)
        )
        self.norm = nn.LayerNorm(size.width, eps=1e-6)

    def embed_patches(self, images: Tensor) -> Tensor:
        """(S, 1 + h w, width): the class token and those of the patches, with their positions."""
        _, channels, height, width = images.shape
        if channels != 3 or height % PATCH or width % PATCH or not height * width:
            raise ValueError(f"images must be (S, 3, H, W), H and W multiples of {PATCH}, got {tuple(images.shape)}")
        patches = self.patch_embed(images)
        tokens = torch.cat([self.cls_token.expand(len(images), -1, -1), patches], 1)
        return tokens + self._positions(height // PATCH, width // PATCH)

    def forward(self, images: Tensor, layers: tuple[int, ...]) -> list[Tensor]:
        """(S, 1 + h w, width) after each of the blocks `layers`, normed, of `normalised` images (S, 3, H, W)."""
        tokens, found = self.embed_patches(images), []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in layers:
                found.append(self.norm(tokens))
        return found

    def _positions(self, rows: int, columns: int) -> Tensor:
        """(1, 1 + rows * columns, width)."""
        grid = self.size.grid
        if rows == columns == grid:
            return self.pos_embed
        learned = self.pos_embed[:, 1:].unflatten(1, (grid, grid)).permute(0, 3, 1, 2)
        # A tenth of a patch more, as in its training: where samples lie follows from the factor and not from the size.
        factor = ((rows + 0.1) / grid, (columns + 0.1) / grid)
        resized = functional.interpolate(learned, scale_factor=factor, mode="bicubic")
        return torch.cat([self.pos_embed[:, :1], resized.flatten(2).transpose(1, 2)], 1)


def normalize_image(image: Tensor) -> Tensor:
    """(3, H, W) as the network wants it, of an image (H, W, 3) in [0, 1]."""
    return ((image - image.new_tensor(MEAN)) / image.new_tensor(STD)).permute(2, 0, 1)
