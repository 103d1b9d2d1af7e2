"""LPIPS, the learned perceptual distance of Zhang et al. 2018 (version 0.1), without torchvision.

The weights are data that the user supplies (see `weights_folder`); without them the metric is not measured. Images are
mapped to [-1, 1], as the metric is defined. The 3DGS and InstantSplat code feeds it [0, 1], so published figures of
that family are not exactly comparable.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class Layer:
    """A convolution and its ReLU, after a pooling (kernel of `pool`, stride 2) where that is not 0."""

    stride: int = 1
    padding: int = 1
    pool: int = 0
    tap: bool = False  # the features after this layer are compared


_ALEX = (
    Layer(stride=4, padding=2, tap=True),
    Layer(padding=2, pool=3, tap=True),
    Layer(pool=3, tap=True),
    Layer(tap=True),
    Layer(tap=True),
)
_VGG = (
    Layer(),
    Layer(tap=True),
    Layer(pool=2),
    Layer(tap=True),
    *(Layer(pool=2), Layer(), Layer(tap=True)) * 3,
)
_NETWORKS = {"alex": (_ALEX, "lpips_alex.pth"), "vgg": (_VGG, "lpips_vgg_fp16.pth")}
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


@dataclass(frozen=True, eq=False)
class Lpips:
    """A loaded network. Calling it compares two images."""

    layers: tuple[Layer, ...]
    weights: Mapping[str, Tensor]  # net.I.weight, net.I.bias: convolutions; linK.weight (1, C, 1, 1): heads

    @torch.no_grad()
    def __call__(self, image: Tensor, truth: Tensor) -> float:
        """The distance of two images (H, W, 3) in [0, 1]; 0 for equal ones. Sides must be at least 64 pixels."""
        if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 64:
            raise ValueError(
                f"images must both be (H, W, 3) of at least 64x64, got {tuple(image.shape)} and {tuple(truth.shape)}"
            )
        x = torch.stack([image, truth]).to(torch.float32).permute(0, 3, 1, 2) * 2 - 1
        x = (x - x.new_tensor(_SHIFT).view(3, 1, 1)) / x.new_tensor(_SCALE).view(3, 1, 1)
        distance, head = 0.0, 0
        for i, layer in enumerate(self.layers):
            if layer.pool:
                x = functional.max_pool2d(x, layer.pool, stride=2)
            weight, bias = self.weights[f"net.{i}.weight"].float(), self.weights[f"net.{i}.bias"].float()
            x = functional.relu(functional.conv2d(x, weight, bias, layer.stride, layer.padding))
            if layer.tap:
                unit = x / (x.norm(dim=1, keepdim=True) + 1e-10)
                difference = (unit[:1] - unit[1:]) ** 2
                distance += float(functional.conv2d(difference, self.weights[f"lin{head}.weight"].float()).mean())
                head += 1
        return distance


def load_lpips(network: str, weights_dir: Path | None = None) -> Lpips | None:
    """The network "alex" or "vgg" with its weights, or None where there are none: the metric is not measured then.

    VGG16's weights stay in half precision; each layer is widened when it is used. Raises ValueError where the file is
    there but holds something else.
    """
    layers, file_name = _NETWORKS[network]
    folder = weights_folder(weights_dir)
    candidates = [] if folder is None else [folder / "lpips" / file_name, folder / file_name]
    path = next((candidate for candidate in candidates if candidate.is_file()), None)
    if path is None:
        return None
    weights = torch.load(path, map_location="cpu", weights_only=True)
    expected = {f"net.{i}.{part}" for i in range(len(layers)) for part in ("weight", "bias")}
    expected |= {f"lin{i}.weight" for i in range(sum(layer.tap for layer in layers))}
    if set(weights) != expected:
        missing = sorted(expected - set(weights))[:3]
        raise ValueError(f"{path} must hold the complete LPIPS network {network!r}; it lacks {missing}")
    return Lpips(layers, weights)


def weights_folder(weights_dir: Path | None = None) -> Path | None:
    """Where network weights lie: `weights_dir`, else $SPLATNODE_WEIGHTS, else shared/weights beside the project."""
    named = weights_dir or os.environ.get("SPLATNODE_WEIGHTS")
    folder = Path(named) if named else Path(__file__).resolve().parents[3] / "shared" / "weights"
    return folder if folder.is_dir() else None
