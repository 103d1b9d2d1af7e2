"""Ensemble: several scenes of the same photographs, and in the end one that agrees with all of them.

Scenes whose refinements draw other random numbers fit the photographs alike, and differ between them. There each has
errors of its own, so the mean of their renders is nearer to the truth than any of them. One scene is refined further,
against the photographs and against that mean at pseudo views: the ensemble is distilled (Hinton et al. 2015).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
import torch
from msgspec import Meta
from torch import Tensor

from splatnode.capture.process.config import Internal
from splatnode.recon.geometry import transform_to_camera
from splatnode.recon.optimize import regularizers
from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.result.snapshot import decode_frame_id
from splatnode.recon.scene import Gaussians, Scene, TrainingView


class EnsembleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Ensemble: several scenes of the same photographs, and in the end one that agrees with all of them."""

    members: Annotated[int, Meta(ge=1)] = 1  # scenes that are refined; 1: that one, and nothing after it
    # Steps of the refinement after them, on photographs as often as on pseudo views; nothing is pruned any more
    iterations: Internal[Annotated[int, Meta(ge=1)]] = 400
    # Its step sizes of Gaussians, of those in `optimize.lr`
    rates: Internal[Annotated[float, Meta(gt=0, le=1)]] = 0.3
    # For each photograph; at most as many as there are steps on them
    pseudo_views: Internal[Annotated[int, Meta(ge=1)]] = 6
    # Their largest distance from the cameras' path, in its steps
    off_path: Internal[Annotated[float, Meta(ge=0)]] = 0.3


def seed_of(member: int, seed: int) -> int:
    """Returns the seed of a member; the first one's is that of a scene by itself."""
    return seed if member == 0 else int(np.random.SeedSequence((seed, member)).generate_state(1)[0])


@torch.no_grad()
def render_between_views(members: Sequence[Scene], config: EnsembleConfig, seed: int) -> list[TrainingView]:
    """Views between the cameras of the first of the members: what they show there in the mean. None of one camera."""
    views, rng = members[0].views, np.random.default_rng(seed)
    count = min(config.pseudo_views * len(views), math.ceil(config.iterations / 2))
    found = regularizers.sample_pseudo_views(views, count, off_path=config.off_path, rng=rng)
    return [
        TrainingView(
            name=f"between {number}",
            frame_id=-1,
            image=(255 * _mean_render(members, view.camera)).round().byte().cpu().numpy(),
            T_world_camera=view.camera.T_world_camera,
            K=view.camera.K,
        )
        for number, view in enumerate(found)
    ]


def _mean_render(members: Sequence[Scene], camera: Camera) -> Tensor:
    """(height, width, 3) in [0, 1]."""
    renders = [render_gaussians(member.gaussians, camera).rgb for member in members]
    return torch.stack([rgb for rgb in renders if rgb is not None]).mean(0).clamp(0, 1)


# Dropout of Gaussians whose depth is uncertain, so that none relies on another in front of it or behind it.
#
# With few photographs, Gaussians along a line of sight share a pixel's colour between them in a way that no other view
# confirms. If any of them may be missing from a render, each has to be right by itself (DropGaussian, Park et al.
# 2025). Unlike the paper, which drops all Gaussians alike, the probability follows the confidence of multi-view
# stereo: where the depth is known, dropout could only cost sharpness.

MAX_OPACITY = 0.9999  # of a Gaussian whose opacity makes up for those that are left out


class DropoutConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Dropout of Gaussians whose depth is uncertain, so that none relies on another in front of it or behind it."""

    share: Internal[float] = 0.4  # probability that a Gaussian of uncertainty 1 is left out of a render; 0: no dropout
    sure: Internal[float] = 0.6  # least confidence of stereo at which the uncertainty is 0
    until: Internal[float] = 0.7  # share of the refinement after which no Gaussian is left out


class Dropout:
    """Draws the Gaussians that each render leaves out."""

    def __init__(self, config: DropoutConfig, gaussians: Gaussians, views: Sequence[TrainingView], seed: int) -> None:
        if not 0 <= config.share < 1:
            raise ValueError(f"dropout.share must be from 0 to below 1, got {config.share}")
        self._config, self._views = config, views
        self._generator = torch.Generator().manual_seed(seed)
        self.follow(gaussians)

    def follow(self, gaussians: Gaussians) -> None:
        """Goes on with `gaussians`, after a density control has changed them."""
        if self._config.share:
            self._probabilities = self._config.share * uncertainty(gaussians, self._views, self._config.sure)
            self._raised = 1 / (1 - self._probabilities)

    def __call__(self, opacities: Tensor, progress: float) -> Tensor:
        """The opacities (N,) of a render at `progress` in [0, 1]: 0 in what is left out, raised in the rest.

        The opacity of a Gaussian that is drawn with probability p is divided by p, so that its mean is the same.
        """
        if self._config.share == 0 or progress >= self._config.until:
            return opacities
        # Drawn on the processor. Memory that a GPU reads by itself lets the copy wait for nothing.
        drawn = torch.rand(len(opacities), generator=self._generator, pin_memory=opacities.is_cuda)
        drawn = drawn.to(opacities, non_blocking=True) >= self._probabilities
        return (opacities * (drawn * self._raised)).clamp(max=MAX_OPACITY)


@torch.no_grad()
def uncertainty(gaussians: Gaussians, views: Sequence[TrainingView], sure: float) -> Tensor:
    """(N,) in [0, 1]: 1 - confidence / `sure` of stereo at the pixel that seeded a Gaussian, at least 0.

    A Gaussian that no view seeded has 1, one whose view has no point map 0.
    """
    device = gaussians.means.device
    result = torch.ones(len(gaussians), device=device)
    for view in views:
        own = (decode_frame_id(gaussians.source_frame) == view.frame_id).nonzero()[:, 0]
        if view.pointmap is None:
            result[own] = 0.0
            continue
        T, K = view.T_world_camera.to(device), view.K.to(device)
        x, y, z = (transform_to_camera(gaussians.means[own], T) @ K.T).unbind(1)
        z = z.clamp(min=1e-6)
        column = (x / z).clamp(0, view.width - 1).long()
        row = (y / z).clamp(0, view.height - 1).long()
        confidence = torch.from_numpy(view.pointmap.confidence).to(device)[row, column]
        result[own] = (1 - confidence / sure).clamp(min=0.0)
    return result
