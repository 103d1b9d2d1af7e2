"""Weights that anyone can make: each tensor is drawn with its name as the seed (../shared/golden/README.md)."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn


def generated(name: str, shape: tuple[int, ...]) -> Tensor:
    """The tensor called `name`: norms near 1, biases small, the rest of the size that keeps variances."""
    rng = np.random.Generator(np.random.PCG64(zlib.crc32(name.encode())))
    noise = rng.standard_normal(shape, dtype=np.float32)
    if "norm" in name and name.endswith("weight"):
        return torch.from_numpy(1 + np.float32(0.05) * noise)
    if len(shape) == 1:
        return torch.from_numpy(np.float32(0.05) * noise)
    return torch.from_numpy(noise * np.float32((1 / np.prod(shape[1:])) ** 0.5))


def generated_images(count: int, height: int, width: int) -> Tensor:
    """(count, 3, H, W), normal noise."""
    return generated("images", (count, 3, height, width)) * (3 * height * width) ** 0.5


def shapes_of(build: Callable[[], nn.Module]) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        return {name: tuple(value.shape) for name, value in build().state_dict().items()}


def generated_weights(build: Callable[[], nn.Module], prefix: str = "") -> dict[str, Tensor]:
    """For all that the network holds; `prefix` leads the names that seed them."""
    return {name: generated(prefix + name, shape) for name, shape in shapes_of(build).items()}
