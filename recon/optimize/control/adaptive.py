"""Adaptive density control of 3D Gaussian splatting (Kerbl et al. 2023, section 5).

Where the positions in the image have large gradients there are too few Gaussians: a small one is cloned, a large one
split into two that are drawn from it. Nearly transparent and too large ones are pruned. From time to time all opacities
are reset to nearly 0, so that only Gaussians that are needed become opaque again.

Shares are of all iterations, of which the publication has 30 000, with a round every 100 and a reset every 3000. In
shorter runs both are fewer, so that every view is part of a round's mean and opacities can recover after a reset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import torch
from torch import Tensor

from splatnode.capture.process.config import Internal
from splatnode.recon.optimize.control import GaussianChange, OptimizerStep
from splatnode.recon.rasterize.reference import compute_rotations
from splatnode.recon.scene import Gaussians, concatenate, logit

NEVER = 2.0  # for `reset_every`: a share of the iterations that is never reached
_EXTENT_MARGIN = 1.1  # the extent over the largest distance of a camera from their mean, as in the authors' code
_PARTS = 2  # into which a large Gaussian is split


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    min_gradient: Internal[float] = 2e-4  # mean length of the gradient, from which on a Gaussian is cloned or split
    every: Internal[int] = 50  # iterations between rounds
    start: Internal[float] = 500 / 30_000  # share of the iterations at which the first round is
    end: Internal[float] = 0.5  # share of the iterations at which the last round is
    reset_every: Internal[float] = 0.2  # share of the iterations between resets
    reset_opacity: Internal[float] = 0.01  # largest opacity after a reset
    min_opacity: Internal[float] = 0.005  # a Gaussian below this opacity is pruned
    # Largest scale of a Gaussian that is cloned and not split, in extents of the scene
    clone_scale: Internal[float] = 0.01
    # After the first reset, a Gaussian with a larger scale is pruned, in extents of the scene
    max_scale: Internal[float] = 0.1
    # Likewise one whose three standard deviations are more in a training view, pixels
    max_radius_px: Internal[float] = 20.0
    split_factor: Internal[float] = 1.6  # scale of a Gaussian over that of its parts
    max_gaussians: Internal[int] = 100_000  # at so many no more are added


def extent(Ts_world_camera: Sequence[Tensor]) -> float:
    """The extent of a scene: 1.1 times the largest distance of a camera centre from their mean."""
    centres = torch.stack([T[:3, 3] for T in Ts_world_camera])
    return _EXTENT_MARGIN * float((centres - centres.mean(0)).norm(dim=1).max())


def image_gradient(step: OptimizerStep) -> Tensor:
    """(N,) length of the loss's gradient with respect to the positions in the image, in halves of the image's sides.

    It follows from the gradient with respect to the means across the line of sight: du = f / z dx.
    """
    means, image = step.gaussians.means, step.images[step.view]
    assert means.grad is not None
    T = step.Ts_world_camera[step.view].to(means.device)
    z = (means.detach() - T[:3, 3]) @ T[:3, 2]
    across = means.grad @ T[:3, :2] * z[:, None]
    halves = torch.tensor([image.width / 2, image.height / 2]) / torch.diagonal(image.K)[:2]
    return (across * halves.to(means.device)).norm(dim=1)


def limit(step: OptimizerStep, config: Config) -> int:
    """The largest number of Gaussians that rounds may lead to."""
    return config.max_gaussians if step.max_gaussians is None else min(config.max_gaussians, step.max_gaussians)


def densify(
    gaussians: Gaussians, gradient: Tensor, size: float, most: int, config: Config, generator: torch.Generator
) -> GaussianChange:
    """Clones and splits Gaussians by their mean gradient (N,), in a scene of extent `size`; none beyond `most`."""
    selected = gradient >= config.min_gradient
    if len(gaussians) + int(selected.sum()) > most:
        selected = torch.zeros_like(selected)
    large = gaussians.scales.amax(1) > config.clone_scale * size
    clones = gaussians.subset(selected & ~large)
    split = gaussians.subset(selected & large)
    kept = ~(selected & large)
    parts = [_sample_children(split, config.split_factor, generator) for _ in range(_PARTS)]
    grown = concatenate([gaussians.subset(kept), clones, *parts])
    rows = torch.nonzero(kept)[:, 0]
    return GaussianChange(grown, torch.cat([rows, rows.new_full((len(grown) - len(rows),), -1)]))


def _sample_children(gaussians: Gaussians, split_factor: float, generator: torch.Generator) -> Gaussians:
    """For each Gaussian one that is smaller by `split_factor`, its mean drawn from it."""
    drawn = torch.randn(gaussians.means.shape, generator=generator).to(gaussians.means.device) * gaussians.scales
    offset = (compute_rotations(gaussians.quats) @ drawn[..., None])[..., 0]
    return replace(gaussians, means=gaussians.means + offset, log_scales=gaussians.log_scales - math.log(split_factor))


def radius_px(gaussians: Gaussians, step: OptimizerStep) -> Tensor:
    """(N,) three standard deviations, in pixels, in the training view in which a Gaussian is largest."""
    largest = torch.zeros_like(gaussians.logit_opacities)
    for T_world_camera, image in zip(step.Ts_world_camera, step.images, strict=True):
        T = T_world_camera.to(largest.device)
        z = (gaussians.means - T[:3, 3]) @ T[:3, 2]
        size = 3.0 * gaussians.scales.amax(1) * float(image.K[0, 0]) / z.clamp_min(1e-6)
        largest = torch.where(z > 0, torch.maximum(largest, size), largest)
    return largest


class AdaptiveControl:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._generator = torch.Generator().manual_seed(seed)
        self._sum = self._count = torch.zeros(0)  # of each Gaussian's gradients since the last round, and how many

    def after_step(self, step: OptimizerStep) -> GaussianChange | None:
        config = self._config
        if step.progress > config.end:
            return None
        self._observe(step)
        gaussians = step.gaussians.map(Tensor.detach)
        change = None
        if is_round(step, config):
            mean = self._sum / self._count.clamp_min(1)
            size, most = extent(step.Ts_world_camera), limit(step, config)
            change = densify(gaussians, mean, size, most, config, self._generator)
            change = self._prune(change, step)
            self._sum = self._count = torch.zeros(0)
        if step.iteration % max(1, round(config.reset_every * step.iterations)) == 0:
            change = change or GaussianChange(gaussians, torch.arange(len(gaussians), device=gaussians.means.device))
            logits = change.gaussians.logit_opacities.clamp_max(logit(config.reset_opacity))
            change = GaussianChange(replace(change.gaussians, logit_opacities=logits), change.origin)
        return change

    def _observe(self, step: OptimizerStep) -> None:
        length = image_gradient(step)
        if len(length) != len(self._sum):
            self._sum, self._count = torch.zeros_like(length), torch.zeros_like(length)
        self._sum += length
        self._count += length > 0

    def _prune(self, change: GaussianChange, step: OptimizerStep) -> GaussianChange:
        config, gaussians = self._config, change.gaussians
        keep = gaussians.opacities >= config.min_opacity
        if step.iteration > config.reset_every * step.iterations:
            keep &= gaussians.scales.amax(1) <= config.max_scale * extent(step.Ts_world_camera)
            keep &= radius_px(gaussians, step) <= config.max_radius_px
        return GaussianChange(gaussians.subset(keep), change.origin[keep])


def is_round(step: OptimizerStep, config: Config) -> bool:
    """Whether Gaussians are added and pruned after this iteration."""
    return config.start <= step.progress <= config.end and step.iteration % config.every == 0


def load(config: Config, seed: int) -> AdaptiveControl:
    return AdaptiveControl(config, seed)
