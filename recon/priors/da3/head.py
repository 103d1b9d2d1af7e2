"""Depth Anything 3's heads: depth with its confidence for every pixel, and a camera for every view."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from splatnode.recon.networks.dinov2 import PATCH
from splatnode.recon.networks.feature_fusion import Scratch, resizers, upsample
from splatnode.recon.networks.transformer import Block, Mlp
from splatnode.recon.priors.da3.backbone import Size

_DETAIL = 32  # channels at full resolution
_POSITION_BASE, _POSITION_WEIGHT = 100.0, 0.1  # of the waves of a pixel's place, as published


class DepthHead(nn.Module):
    """A dense prediction transformer; the checkpoint holds a second one, for rays, that is not needed."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        width, widths = size.head_width, size.head_layer_widths
        self.norm = nn.LayerNorm(2 * size.vit.width)
        self.projects = nn.ModuleList(nn.Conv2d(2 * size.vit.width, each, 1) for each in widths)
        self.resize_layers = resizers(widths)
        self.scratch = _DepthScratch(widths, width)

    def forward(self, layers: Sequence[Tensor], height: int, width: int) -> tuple[Tensor, Tensor]:
        """(S, H, W) depth, and confidence from 1, from four layers' tokens (S, h w, C)."""
        grid, aspect = (height // PATCH, width // PATCH), width / height
        images = []
        for tokens, project, resize in zip(layers, self.projects, self.resize_layers, strict=True):
            image = project(self.norm(tokens).transpose(1, 2).unflatten(2, grid))
            images.append(resize(_add_position_waves(image, aspect)))
        fused = self.scratch.output_conv1(self.scratch.fuse(images))
        raw = self.scratch.output_conv2(_add_position_waves(upsample(fused, (height, width)), aspect))
        return raw[:, 0].exp(), 1.0 + raw[:, 1].exp()


class _DepthScratch(Scratch):
    def __init__(self, widths: Sequence[int], width: int) -> None:
        super().__init__(widths, width, whole_last=False)
        self.output_conv1 = nn.Conv2d(width, width // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(width // 2, _DETAIL, 3, padding=1), nn.ReLU(), nn.Conv2d(_DETAIL, 2, 1)
        )


class CameraHead(nn.Module):
    """Position, rotation and fields of view from a view's camera token."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        width = 2 * size.vit.width
        self.backbone = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t, self.fc_qvec = nn.Linear(width, 3), nn.Linear(width, 4)
        self.fc_fov = nn.Sequential(nn.Linear(width, 2), nn.ReLU())

    def forward(self, tokens: Tensor) -> Tensor:
        """(S, 9) position (3) and rotation (quaternion xyzw) of the camera in the world, field of view (y, x)."""
        x = self.backbone(tokens)
        return torch.cat([self.fc_t(x), self.fc_qvec(x), self.fc_fov(x)], -1)


class CameraEncoder(nn.Module):
    """Tokens of known cameras, in place of those that ask for them."""

    def __init__(self, size: Size, depth: int = 4) -> None:
        super().__init__()
        width = size.vit.width
        self.pose_branch = Mlp(9, width // 2, width)
        self.token_norm, self.trunk_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.trunk = nn.ModuleList(Block(width, size.camera_heads, scaled=True, epsilon=1e-5) for _ in range(depth))

    def forward(self, cameras: Tensor) -> Tensor:
        """(S, width) of (S, 9) cameras as `CameraHead` gives them."""
        tokens = self.token_norm(self.pose_branch(cameras))
        for block in self.trunk:
            tokens = block(tokens)
        return self.trunk_norm(tokens)


def _add_position_waves(image: Tensor, aspect: float) -> Tensor:
    """(S, C, h, w) with sines and cosines of each pixel's place added; `aspect` is the photograph's width by height."""
    _, channels, height, width = image.shape
    diagonal = (1.0 + aspect**2) ** 0.5
    quarter = channels // 4
    frequencies = _POSITION_BASE ** (-torch.arange(quarter, dtype=torch.float32) / quarter)

    def waves(extent: float, count: int) -> Tensor:
        """(C / 2, count) along a side that reaches from -extent to extent."""
        edge = extent * (count - 1) / count
        angles = frequencies[:, None] * torch.linspace(-edge, edge, count)
        return torch.cat([angles.sin(), angles.cos()])

    across, down = waves(aspect / diagonal, width), waves(1.0 / diagonal, height)
    waved = torch.cat([across[:, None].expand(-1, height, -1), down[:, :, None].expand(-1, -1, width)])
    return image + _POSITION_WEIGHT * waved
