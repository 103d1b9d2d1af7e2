"""How alike two images look: LPIPS where its weights are there, structure over several scales where they are not.

An image to be compared with again and again is `prepared` once. Which one served is its `name`, for the report.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from splatnode.recon.networks.lpips import Lpips, load_lpips

Distance = Callable[[Tensor], Tensor]  # image (H, W, 3) in [0, 1] -> scalar with gradients


class Perceptual(Protocol):
    @property
    def name(self) -> str: ...

    def prepared(self, truth: Tensor) -> Distance:
        """The distance from `truth` (H, W, 3) in [0, 1]; 0 for equal images."""
        ...


@dataclass(frozen=True, eq=False)
class LpipsDistance:
    network: Lpips
    name: str

    def prepared(self, truth: Tensor) -> Distance:
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

    def prepared(self, truth: Tensor) -> Distance:
        expected = [_slopes(level) for level in _pyramid(truth, self.scales)]
        strength = [sum(slope.abs().mean() for slope in level) + 1e-3 for level in expected]

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
    network = load_lpips("alex", weights_dir)
    return MultiScaleGradient() if network is None else LpipsDistance(network, "LPIPS AlexNet")


def _pyramid(image: Tensor, scales: int) -> list[Tensor]:
    """[(3, H, W), (3, H/2, W/2), ...], as long as a side has at least 8 pixels."""
    levels = [image.permute(2, 0, 1)]
    while len(levels) < scales and min(levels[-1].shape[1:]) >= 16:
        levels.append(functional.avg_pool2d(levels[-1], 2))
    return levels


def _slopes(image: Tensor) -> tuple[Tensor, Tensor]:
    return image[:, :, 1:] - image[:, :, :-1], image[:, 1:] - image[:, :-1]
