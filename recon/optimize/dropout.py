"""Doubtful Gaussians left out at random while they are fitted, so that none relies on what stands before or behind it.

From few photographs, Gaussians along a line of sight share a pixel's colour between them in a way that no other view
confirms. When any may be missing each must be right by itself (DropGaussian, Park et al. 2025). Beyond the paper, what
stereo is sure of is never left out: its place is known, and all that it could lose is sharpness.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import torch
from torch import Tensor

from splatnode.recon.geometry import to_camera
from splatnode.recon.scene.gaussians import Gaussians
from splatnode.recon.scene.scene import TrainingView

MOST_OPACITY = 0.9999


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    share: float = 0.0  # of the Gaussians of which stereo knows nothing, left out of a render; 0: none
    sure: float = 0.6  # confidence of stereo from which on none is left out; below, in proportion
    until: float = 0.7  # part of the refinement; after it all are there


class Dropout:
    """Draws what each render leaves out."""

    def __init__(self, config: Config, gaussians: Gaussians, views: Sequence[TrainingView], seed: int) -> None:
        if not 0 <= config.share < 1:
            raise ValueError(f"dropout.share must be from 0 to below 1, got {config.share}")
        self._config, self._views = config, views
        self._generator = torch.Generator().manual_seed(seed)
        self.follow(gaussians)

    def follow(self, gaussians: Gaussians) -> None:
        """From here on it is asked about these."""
        if self._config.share:
            self._shares = self._config.share * doubt(gaussians, self._views, self._config.sure)

    def __call__(self, opacities: Tensor, progress: float) -> Tensor:
        """The opacities (N,) of a render at `progress` in [0, 1]: 0 in some, and the more in the others."""
        if self._config.share == 0 or progress >= self._config.until:
            return opacities
        there = torch.rand(len(opacities), generator=self._generator) >= self._shares
        return (opacities * (there / (1 - self._shares))).clamp(max=MOST_OPACITY)


@torch.no_grad()
def doubt(gaussians: Gaussians, views: Sequence[TrainingView], sure: float) -> Tensor:
    """(N,) from 0 for Gaussians on pixels that stereo is `sure` of to 1 for those of which it knows nothing.

    Each is looked up in the view that started it; what none did is doubted. Views without a point map doubt nothing.
    """
    result = torch.ones(len(gaussians))
    for view in views:
        own = (gaussians.source_frame == view.frame_id).nonzero()[:, 0]
        if view.pointmap is None:
            result[own] = 0.0
            continue
        T, K = view.T_world_camera, view.K
        x, y, z = (to_camera(gaussians.means[own], T) @ K.T).unbind(1)
        z = z.clamp(min=1e-6)
        column = (x / z).clamp(0, view.width - 1).long()
        row = (y / z).clamp(0, view.height - 1).long()
        confidence = torch.from_numpy(view.pointmap.confidence)[row, column]
        result[own] = (1 - confidence / sure).clamp(min=0.0)
    return result
