"""ALIKED's network: maps of features and of keypoint scores, then descriptors of the best keypoints.

"ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable Transformation" (Zhao et al. 2023),
section III. Parameters are called as in the authors' checkpoints.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from splatnode.recon.networks.weight_loading import load_network, read_weights
from splatnode.recon.priors.aliked.deformable import DeformableConv, DeformableDescriptor
from splatnode.recon.priors.aliked.detection import detect_keypoints

STRIDE = 32  # of the coarsest features: an image has sides that this divides
_STRIDES = (1, 2, 8, STRIDE)
_N16 = 16  # width of the N16 network


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The best keypoints of an image, the best first."""

    points: Tensor  # (M, 2) pixels, top-left pixel centre at (0.5, 0.5)
    descriptors: Tensor  # (M, C) of unit length


class Aliked(nn.Module):
    """N16 has `width` 16, T16 8: channels at full size, which double at each coarser size."""

    def __init__(self, width: int = _N16) -> None:
        super().__init__()
        widths = [width << level for level in range(4)]
        channels = widths[-1]  # of descriptors
        self.block1 = _Block(3, widths[0], deformable=False)
        self.block2 = _ResidualBlock(widths[0], widths[1], deformable=False)
        self.block3 = _ResidualBlock(widths[1], widths[2], deformable=True)
        self.block4 = _ResidualBlock(widths[2], widths[3], deformable=True)
        self.conv1, self.conv2, self.conv3, self.conv4 = (_conv(each, channels // 4, 1) for each in widths)
        self.score_head = nn.Sequential(
            _conv(channels, 8, 1), nn.SELU(), _conv(8, 4, 3), nn.SELU(), _conv(4, 4, 3), nn.SELU(), _conv(4, 1, 3)
        )
        self.desc_head = DeformableDescriptor(channels)

    def compute_maps(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Features (C, H, W) of unit length, and scores (H, W) from 0 to 1, of an RGB image (3, H, W) in [0, 1].

        Raises ValueError where the image's sides are no multiples of STRIDE.
        """
        if image.ndim != 3 or len(image) != 3 or image.shape[1] % STRIDE or image.shape[2] % STRIDE:
            raise ValueError(f"image must be (3, H, W) with sides that {STRIDE} divides, got {tuple(image.shape)}")
        size = image.shape[1:]
        levels = [self.block1(image[None])]
        for block, finer, coarser in zip((self.block2, self.block3, self.block4), _STRIDES, _STRIDES[1:], strict=False):
            levels.append(block(F.avg_pool2d(levels[-1], coarser // finer)))
        reduced = [
            F.selu(conv(level))
            for conv, level in zip((self.conv1, self.conv2, self.conv3, self.conv4), levels, strict=True)
        ]
        together = torch.cat(
            [reduced[0], *(F.interpolate(each, size, mode="bilinear", align_corners=True) for each in reduced[1:])], 1
        )
        scores = torch.sigmoid(self.score_head(together))
        return F.normalize(together, dim=1)[0], scores[0, 0]

    def forward(self, image: Tensor, count: int) -> Keypoints:
        """At most `count` keypoints of an image as `compute_maps` takes it."""
        features, scores = self.compute_maps(image)
        positions = detect_keypoints(scores, count)
        return Keypoints(positions + 0.5, self.desc_head(features, positions))


class _Block(nn.Module):
    """Two convolutions of 3 x 3, each with its normalisation."""

    def __init__(self, channels: int, out_channels: int, deformable: bool) -> None:
        super().__init__()
        conv = DeformableConv if deformable else _conv
        self.conv1, self.bn1 = conv(channels, out_channels), nn.BatchNorm2d(out_channels)
        self.conv2, self.bn2 = conv(out_channels, out_channels), nn.BatchNorm2d(out_channels)

    def forward(self, maps: Tensor) -> Tensor:
        return F.selu(self._convolve(maps))

    def _convolve(self, maps: Tensor) -> Tensor:
        return self.bn2(self.conv2(F.selu(self.bn1(self.conv1(maps)))))


class _ResidualBlock(_Block):
    """They are added to what came in, brought to their width."""

    def __init__(self, channels: int, out_channels: int, deformable: bool) -> None:
        super().__init__(channels, out_channels, deformable)
        self.downsample = nn.Conv2d(channels, out_channels, 1)

    def forward(self, maps: Tensor) -> Tensor:
        return F.selu(self._convolve(maps) + self.downsample(maps))


def _conv(channels: int, out_channels: int, size: int = 3) -> nn.Conv2d:
    return nn.Conv2d(channels, out_channels, size, padding=size // 2, bias=False)


def load_aliked(path: Path) -> Aliked:
    """Raises FileNotFoundError, or ValueError where the file is damaged or not the checkpoint of N16 or T16."""
    weights = read_weights(path)
    first = weights.get("block1.conv1.weight")
    small = first is not None and len(first) == _N16 // 2
    width, name = (_N16 // 2, "ALIKED T16") if small else (_N16, "ALIKED N16")
    return load_network(lambda: Aliked(width), weights, path, name)
