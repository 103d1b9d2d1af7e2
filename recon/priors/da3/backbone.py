"""Depth Anything 3's transformer: DINOv2, of which every second block of the later ones looks at all views at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from splatnode.recon.networks import dinov2
from splatnode.recon.networks.dinov2 import Dinov2
from splatnode.recon.networks.rotary import Rotary, grid_positions

_MIN_VIEWS_TO_CHOOSE = 3  # with fewer, the first view is the reference


@dataclass(frozen=True)
class Size:
    """The defaults are those of the published Small."""

    vit: dinov2.Size = dinov2.SMALL
    joint_from: int = 4  # the first of the later blocks
    layers: tuple[int, int, int, int] = (5, 7, 9, 11)  # whose tokens the heads get
    head_width: int = 64
    head_layer_widths: tuple[int, int, int, int] = (48, 96, 192, 384)
    camera_heads: int = 16


SMALL = Size()


@dataclass(frozen=True, eq=False)
class Features:
    """Each layer's tokens within the views beside those across them."""

    patches: list[Tensor]  # (S, h w, 2 width) of each layer, the second half normed
    cameras: Tensor  # (S, 2 width) of the last layer, not normed


class Backbone(Dinov2):
    """DINOv2 with a token for each view's camera, and attention across views in every second later block."""

    def __init__(self, size: Size) -> None:
        super().__init__(size.vit, masks=False, normed_from=size.joint_from)
        self.camera_token = nn.Parameter(torch.zeros(1, 2, size.vit.width))  # of the reference, and of other views
        self.norm = nn.LayerNorm(size.vit.width)
        self._joint_from, self._layers = size.joint_from, size.layers

    def encode_views(self, images: Tensor, cameras: Tensor | None) -> Features:
        """Encodes images (S, 3, H, W) of `normalize_image`; `cameras` (S, width) are tokens of known ones."""
        tokens = self.embed_patches(images)
        rows, columns = (side // dinov2.PATCH for side in images.shape[2:])
        within, across = self._rotaries(rows, columns, len(images))
        order = torch.arange(len(images))
        own = tokens
        patches, last = [], tokens
        for index, block in enumerate(self.blocks):
            if index == self._joint_from - 1 and cameras is None and len(images) >= _MIN_VIEWS_TO_CHOOSE:
                order = _order_reference_first(tokens[:, 0])
                tokens, own = tokens[order], own[order]
            if index == self._joint_from:
                tokens = torch.cat([self._camera_tokens(cameras, len(images))[:, None], tokens[:, 1:]], 1)
            if index >= self._joint_from and index % 2:
                tokens = block(tokens.flatten(0, 1)[None], across)[0].unflatten(0, (len(images), -1))
            else:
                tokens = own = block(tokens, within if index >= self._joint_from else None)
            if index in self._layers:
                last = torch.cat([own, tokens], -1)[order.argsort()]
                own_half, joint_half = last.chunk(2, dim=-1)
                patches.append(torch.cat([own_half, self.norm(joint_half)], -1)[:, 1:])
        return Features(patches, last[:, 0])

    def _camera_tokens(self, cameras: Tensor | None, count: int) -> Tensor:
        if cameras is not None:
            return cameras
        reference, other = self.camera_token[0]
        return torch.stack([reference, *[other] * (count - 1)])

    def _rotaries(self, rows: int, columns: int, count: int) -> tuple[Rotary, Rotary]:
        """Within a view patches are at their places from 1 and the camera's token at 0; across views all are at 1."""
        dimension = self.size.width // self.size.heads
        places = torch.cat([torch.zeros(1, 2), 1.0 + grid_positions(rows, columns)])
        return Rotary.create_from_positions(places, dimension), Rotary.create_from_positions(
            places.clamp(max=1.0).repeat(count, 1), dimension
        )


def _order_reference_first(tokens: Tensor) -> Tensor:
    """The order of views (S,) by their class tokens (S, C): first the most usual one, then the others as they came.

    It is the one whose likeness to the others, length and variance lie nearest to the middle of their ranges.
    """
    unit = tokens / tokens.norm(dim=-1, keepdim=True)
    likeness = (unit @ unit.T).sum(-1) - 1.0
    offset = torch.zeros(len(tokens))
    for measure in (likeness / (len(tokens) - 1), tokens.norm(dim=-1), unit.var(dim=-1)):
        least, most = measure.min(), measure.max()
        offset += ((measure - least) / (most - least + 1e-8) - 0.5).abs()
    reference = int(offset.argmin())
    return torch.tensor([reference, *(view for view in range(len(tokens)) if view != reference)])
