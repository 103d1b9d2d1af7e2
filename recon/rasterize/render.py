"""Render: what every rasteriser returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Render:
    """An image of the Gaussians. A channel that was not asked for is None."""

    rgb: Tensor | None  # (H, W, 3) on black: sum of w_k c_k (equation 2)
    depth: Tensor | None  # (H, W) expected z in the camera frame: sum of w_k z_k / sum of w_k, 0 where alpha is 0
    normal: Tensor | None  # (H, W, 3) sum of w_k n_k in the camera frame, facing the camera (equation 4)
    alpha: Tensor | None  # (H, W) sum of w_k

    def move_to_device(self, device: torch.device) -> Render:
        """The same image on `device`; gradients find their way back."""
        channels = (self.rgb, self.depth, self.normal, self.alpha)
        return Render(*(None if channel is None else channel.to(device) for channel in channels))
