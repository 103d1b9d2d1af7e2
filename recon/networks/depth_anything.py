"""Depth Anything V2 (Yang et al. 2024): the depth of a single photograph, up to scale and offset or in metres.

Written from the paper; modules carry the names of the official checkpoints, of which there are two kinds: for inverse
depth of anything, and for metres indoors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatnode.recon import networks
from splatnode.recon.networks import locate_weights
from splatnode.recon.networks import vit as networks_vit
from splatnode.recon.networks.vit import PATCH, Crop, Dinov2, crop, crop_image, normalize_image

# Fusion of features from coarse to fine: the decoder of dense prediction transformers (DPT, Ranftl et al. 2021).


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


RELATIVE = "depth_anything_v2/depth_anything_v2_vits.pth"
METRIC = "depth_anything_v2/depth_anything_v2_metric_hypersim_vits.pth"
INDOORS_M = 20.0  # metres at most, of the network for metres indoors
_LONGER_SIDE = 518  # of the network's images, pixels: what it was trained with
_DETAIL = 32  # channels at full resolution


@dataclass(frozen=True)
class Size:
    """The defaults are those of the published Small."""

    vit: networks_vit.Size = networks_vit.SMALL
    layers: tuple[int, int, int, int] = (2, 5, 8, 11)
    head_width: int = 64
    head_layer_widths: tuple[int, int, int, int] = (48, 96, 192, 384)


SMALL = Size()


class DepthAnythingV2(nn.Module):
    """DINOv2 with the decoder of a dense prediction transformer."""

    def __init__(self, size: Size = SMALL, *, max_m: float | None = None) -> None:
        """`max_m`: the network answers in metres up to this; None: it answers inverse depths."""
        super().__init__()
        self._layers, self._max_m = size.layers, max_m
        self.pretrained = Dinov2(size.vit)
        self.depth_head = _Head(size)

    @torch.inference_mode()
    def forward(self, image: Tensor) -> Tensor:
        """(H, W) inverse depth up to scale and offset, or metres, of a `dinov2.normalised` image (3, H, W).

        Sides must be multiples of `dinov2.PATCH`.
        """
        raw = self.depth_head(self.pretrained(image[None], self._layers), *image.shape[1:])[0, 0]
        return torch.relu(raw) if self._max_m is None else self._max_m * torch.sigmoid(raw)


class _Head(nn.Module):
    """A dense prediction transformer's decoder (Ranftl et al. 2021)."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        self.projects = nn.ModuleList(nn.Conv2d(size.vit.width, each, 1) for each in size.head_layer_widths)
        self.resize_layers = resizers(size.head_layer_widths)
        self.scratch = _HeadScratch(size.head_layer_widths, size.head_width)

    def forward(self, layers: Sequence[Tensor], height: int, width: int) -> Tensor:
        """(1, 1, height, width) raw values from four layers' tokens (1, 1 + h w, C), the class token first."""
        grid = height // PATCH, width // PATCH
        images = [
            resize(project(tokens[:, 1:].transpose(1, 2).unflatten(2, grid)))
            for tokens, project, resize in zip(layers, self.projects, self.resize_layers, strict=True)
        ]
        fused = self.scratch.output_conv1(self.scratch.fuse(images))
        return self.scratch.output_conv2(upsample(fused, (height, width)))


class _HeadScratch(Scratch):
    def __init__(self, widths: Sequence[int], width: int) -> None:
        super().__init__(widths, width)
        self.output_conv1 = nn.Conv2d(width, width // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(width // 2, _DETAIL, 3, padding=1), nn.ReLU(), nn.Conv2d(_DETAIL, 1, 1)
        )


def load_network(path: Path, size: Size = SMALL, *, max_m: float | None = None) -> DepthAnythingV2:
    """Raises ValueError where the file is damaged, holds another model or anything but data, and FileNotFoundError."""
    build = partial(DepthAnythingV2, size, max_m=max_m)
    return networks.load_network(build, networks.read_weights(path), path, "Depth Anything V2 Small")


@dataclass(frozen=True, eq=False)
class Monocular:
    """Photographs through a network of either kind."""

    network: DepthAnythingV2
    name: str
    longer_side: int = _LONGER_SIDE

    def __call__(self, image: npt.NDArray[np.uint8]) -> tuple[npt.NDArray[np.float32], Crop]:
        """Runs the network on an image (H, W, 3); returns its output, and how the image was scaled and cut."""
        to = crop(image.shape[1], image.shape[0], self.longer_side, PATCH)
        return self.network(normalize_image(crop_image(image, to))).numpy(), to


def load_relative() -> Monocular | None:
    """The network for inverse depths; None without weights. Raises ValueError where they are of another model."""
    path = locate_weights(RELATIVE)
    return None if path is None else Monocular(load_network(path), "Depth Anything V2 Small")


def load_metric() -> Monocular | None:
    """The network for metres indoors; None without weights. Raises ValueError where they are of another model."""
    path = locate_weights(METRIC)
    if path is None:
        return None
    return Monocular(load_network(path, max_m=INDOORS_M), "Depth Anything V2 Metric Indoor Small")
