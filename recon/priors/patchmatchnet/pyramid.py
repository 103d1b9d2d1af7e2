"""PatchmatchNet's image networks: a pyramid of features, and depth made twice as fine along a photograph's edges."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class _ConvNormRelu(nn.Module):
    """Convolution, batch norm and ReLU."""

    def __init__(self, channels: int, out: int, size: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, size, stride, size // 2, bias=False)
        self.bn = nn.BatchNorm2d(out)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.bn(self.conv(x)))


class FeaturePyramid(nn.Module):
    """A feature pyramid: channels 64, 32 and 16 at 1/8, 1/4 and 1/2 of the image's size."""

    def __init__(self) -> None:
        super().__init__()
        self.conv0, self.conv1 = _ConvNormRelu(3, 8), _ConvNormRelu(8, 8)
        self.conv2, self.conv3, self.conv4 = _make_halving_layers(8, 16)
        self.conv5, self.conv6, self.conv7 = _make_halving_layers(16, 32)
        self.conv8, self.conv9, self.conv10 = _make_halving_layers(32, 64)
        self.output1 = nn.Conv2d(64, 64, 1, bias=False)
        self.inner1, self.inner2 = nn.Conv2d(32, 64, 1), nn.Conv2d(16, 64, 1)
        self.output2, self.output3 = nn.Conv2d(64, 32, 1, bias=False), nn.Conv2d(64, 16, 1, bias=False)

    def forward(self, image: Tensor) -> dict[int, Tensor]:
        """(C, H / 2^level, W / 2^level) by level, of an image (3, H, W)."""
        half = self.conv4(self.conv3(self.conv2(self.conv1(self.conv0(image[None])))))
        quarter = self.conv7(self.conv6(self.conv5(half)))
        eighth = self.conv10(self.conv9(self.conv8(quarter)))
        quarter = _upsample(eighth) + self.inner1(quarter)
        half = _upsample(quarter) + self.inner2(half)
        return {3: self.output1(eighth)[0], 2: self.output2(quarter)[0], 1: self.output3(half)[0]}


def _make_halving_layers(channels: int, out: int) -> tuple[_ConvNormRelu, _ConvNormRelu, _ConvNormRelu]:
    return _ConvNormRelu(channels, out, size=5, stride=2), _ConvNormRelu(out, out), _ConvNormRelu(out, out)


def _upsample(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


class Refinement(nn.Module):
    """Depth at twice its size, sharpened along the photograph's edges."""

    def __init__(self) -> None:
        super().__init__()
        self.conv0, self.conv1, self.conv2 = _ConvNormRelu(3, 8), _ConvNormRelu(1, 8), _ConvNormRelu(8, 8)
        self.deconv = nn.ConvTranspose2d(8, 8, 3, stride=2, padding=1, output_padding=1, bias=False)
        self.bn = nn.BatchNorm2d(8)
        self.conv3 = _ConvNormRelu(16, 8)
        self.res = nn.Conv2d(8, 1, 3, padding=1, bias=False)

    def forward(self, image: Tensor, depth: Tensor, near_far: tuple[float, float]) -> Tensor:
        """(H, W) depth from `depth` (H / 2, W / 2) and the photograph `image` (3, H, W)."""
        near, far = near_far
        place = ((depth - near) / (far - near))[None, None]
        detail = torch.relu(self.bn(self.deconv(self.conv2(self.conv1(place)))))
        detail = self.res(self.conv3(torch.cat([detail, self.conv0(image[None])], 1)))
        place = functional.interpolate(place, scale_factor=2.0, mode="nearest") + detail
        return place[0, 0] * (far - near) + near
