"""Fusion of features from coarse to fine: the decoder of dense prediction transformers (DPT, Ranftl et al. 2021)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional


class Scratch(nn.Module):
    """Brings feature maps of four widths and sizes to one width, and fuses them. Checkpoints call it `scratch`."""

    def __init__(self, widths: Sequence[int], width: int, *, whole_last: bool = True) -> None:
        """`whole_last`: the coarsest fusion has weights for a finer image although there is none."""
        super().__init__()
        reduce = [nn.Conv2d(each, width, 3, padding=1, bias=False) for each in widths]
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = reduce
        self.refinenet1, self.refinenet2, self.refinenet3 = (Fusion(width) for _ in range(3))
        self.refinenet4 = Fusion(width, joins=whole_last)

    def fuse(self, images: Sequence[Tensor]) -> Tensor:
        """(S, width, 2h, 2w) from images (S, C, h, w), the finest first, at twice the finest one's size."""
        first, second, third, fourth = (
            reduce(image)
            for reduce, image in zip(
                (self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn), images, strict=True
            )
        )
        fused = self.refinenet4(fourth, size=third.shape[2:])
        fused = self.refinenet3(fused, third, size=second.shape[2:])
        fused = self.refinenet2(fused, second, size=first.shape[2:])
        return self.refinenet1(fused, first)


def resizers(widths: Sequence[int]) -> nn.ModuleList:
    """Modules that bring feature maps of four layers, of the size of the patch grid, to 4, 2, 1 and 1/2 times that."""
    first, second, _, last = widths
    return nn.ModuleList(
        [
            nn.ConvTranspose2d(first, first, 4, stride=4),
            nn.ConvTranspose2d(second, second, 2, stride=2),
            nn.Identity(),
            nn.Conv2d(last, last, 3, stride=2, padding=1),
        ]
    )


class Fusion(nn.Module):
    """One step: a coarser map is refined by a finer one, then enlarged. Checkpoints call it `refinenet`."""

    def __init__(self, width: int, *, joins: bool = True) -> None:
        """`joins`: whether it can take a finer image in."""
        super().__init__()
        if joins:
            self.resConfUnit1 = _Residual(width)
        self.resConfUnit2 = _Residual(width)
        self.out_conv = nn.Conv2d(width, width, 1)

    def forward(self, coarse: Tensor, fine: Tensor | None = None, size: Sequence[int] | None = None) -> Tensor:
        """At `size` (H, W), or twice as large as it was."""
        fused = coarse if fine is None else coarse + self.resConfUnit1(fine)
        fused = self.resConfUnit2(fused)
        # The convolution has one tap: before the upsampling it gives the same for a quarter of the work.
        return upsample(self.out_conv(fused), size or [2 * side for side in fused.shape[2:]])


class _Residual(nn.Module):
    """A residual unit of two convolutions, each after its ReLU."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(torch.relu(self.conv1(torch.relu(x))))


def upsample(image: Tensor, size: Sequence[int]) -> Tensor:
    """Images (S, C, h, w) as (S, C, H, W) of `size` (H, W), bilinear, corners on corners."""
    return functional.interpolate(image, size=tuple(size), mode="bilinear", align_corners=True)
