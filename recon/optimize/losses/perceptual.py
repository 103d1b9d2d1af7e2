"""Perceptual distance of two images: LPIPS where its weights are present, else image gradients over several scales."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from splatnode.recon.networks.lpips import Lpips, load_lpips

_MIN_SIDE = 8  # pixels, of the smallest level of a pyramid
_FLAT = 1e-3  # mean gradient that is added to the truth's: a flat image divides by it

Distance = Callable[[Tensor], Tensor]  # image (H, W, 3) in [0, 1] -> scalar with gradients


class Perceptual(Protocol):
    @property
    def name(self) -> str:
        """Which measure it is, for the report."""
        ...

    def prepare_distance(self, truth: Tensor) -> Distance:
        """The distance from `truth` (H, W, 3) in [0, 1], whose own features are computed once; 0 for equal images."""
        ...


@dataclass(frozen=True, eq=False)
class LpipsDistance:
    network: Lpips
    name: str

    def prepare_distance(self, truth: Tensor) -> Distance:
        with torch.no_grad():
            features = self.network.features(truth)
        return lambda image: self.network.distance(image, features)


@dataclass(frozen=True)
class MultiScaleGradient:
    """Mean difference of image gradients over an octave pyramid, relative to the truth's own gradients.

    Edges must lie where the truth has them and be as strong; colour offsets cost nothing. It needs no weights.
    """

    scales: int = 4
    name: str = "multi-scale gradient"

    def prepare_distance(self, truth: Tensor) -> Distance:
        expected = [_slopes(level) for level in _pyramid(truth, self.scales)]
        strength = [sum(slope.abs().mean() for slope in level) + _FLAT for level in expected]

        def distance(image: Tensor) -> Tensor:
            found = [_slopes(level) for level in _pyramid(image, self.scales)]
            parts = [
                sum((mine - true).abs().mean() for mine, true in zip(level, truths, strict=True)) / total
                for level, truths, total in zip(found, expected, strength, strict=True)
            ]
            return torch.stack([torch.as_tensor(part) for part in parts]).mean()

        return distance


def load_perceptual(weights_dir: Path | None = None) -> Perceptual:
    """LPIPS with AlexNet, or the multi-scale gradient where its weights are not there."""
    return load_alex(weights_dir) or MultiScaleGradient()


def load_alex(weights_dir: Path | None = None) -> LpipsDistance | None:
    """LPIPS with AlexNet; None where its weights are not there."""
    network = load_lpips("alex", weights_dir)
    return None if network is None else LpipsDistance(network, "LPIPS AlexNet")


def _pyramid(image: Tensor, scales: int) -> list[Tensor]:
    """[(3, H, W), (3, H/2, W/2), ...], as long as both sides have at least 8 pixels."""
    levels = [image.permute(2, 0, 1)]
    while len(levels) < scales and min(levels[-1].shape[1:]) >= 2 * _MIN_SIDE:
        levels.append(functional.avg_pool2d(levels[-1], 2))
    return levels


def _slopes(image: Tensor) -> tuple[Tensor, Tensor]:
    return image[:, :, 1:] - image[:, :, :-1], image[:, 1:] - image[:, :-1]
