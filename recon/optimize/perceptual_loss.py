"""Perceptual loss on photographs: the render of a training view must have its photograph's texture.

L1 and D-SSIM leave faint grain out, since a render without it is nearer to the photograph, pixel by pixel, than one
with other grain. LPIPS tells them apart. It takes as long as several steps, so it counts in every few steps alone, with
so many times its weight. Its weights are the user's (`splatnode weights`): without them it does not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from splatnode.recon.networks.lpips import MIN_SIDE
from splatnode.recon.optimize.losses.loss import Schedule
from splatnode.recon.optimize.losses.perceptual import Distance, LpipsDistance, load_alex


class PerceptualLossConfig(Schedule, frozen=True, forbid_unknown_fields=True):
    """None by default. The weight is of each step, in the mean."""

    start: float = 0.5  # share of the iterations after which it counts
    every: Annotated[int, Meta(ge=1)] = 5  # steps from one in which it counts to the next one

    def weight_in_step(self, step: int, progress: float) -> float:
        """The weight in step `step`, counted from 0, at `progress` in [0, 1]; 0 where the loss is not computed."""
        return 0.0 if step % self.every else self.every * self.weight_at(progress)


@dataclass(frozen=True, eq=False)
class PerceptualLoss:
    """LPIPS of a render against a photograph, where that shows the scene."""

    distance: Distance  # from the photograph
    target: Tensor  # (H, W, 3) the photograph
    shown: Tensor | None  # (H, W, 1) bool: False where it is not compared; None: all of it is

    def __call__(self, rgb: Tensor) -> Tensor:
        """The distance of a render (H, W, 3), scalar, with gradients."""
        return self.distance(rgb if self.shown is None else torch.where(self.shown, rgb, self.target))


def load(config: PerceptualLossConfig, device: torch.device) -> LpipsDistance | None:
    """The measure, on `device`; None where the weight is 0, or no weights of the network are there."""
    found = load_alex() if config.weight else None
    return None if found is None else replace(found, network=found.network.move_to_device(device))


def perceptual_loss(
    measure: LpipsDistance | None, target: Tensor, weights: Tensor | None, keep_features: bool
) -> Callable[[Tensor], Tensor] | None:
    """The loss against `target` (H, W, 3), where `weights` (H, W) are not 0; None where nothing can be computed.

    What the network sees in a photograph takes about 40 bytes a pixel while it is kept.
    """
    if measure is None or min(target.shape[:2]) < MIN_SIDE:
        return None
    distance = measure.prepare_distance(target) if keep_features else lambda rgb: measure.prepare_distance(target)(rgb)
    return PerceptualLoss(distance, target, None if weights is None else (weights > 0)[..., None])
