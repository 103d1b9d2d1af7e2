"""Adaptive density control of 3D Gaussian splatting (Kerbl et al. 2023, section 5).

Where the loss pulls strongly at where Gaussians appear in the image, there are too few: a small one is doubled, a large
one replaced by two that are drawn from it. What is nearly transparent or too large goes; and once in a while all become
nearly transparent, so that only what is needed comes back.

Shares are of all iterations, of which the publication has 30 000, with a round every 100 and a reset every 3000. In
shorter runs both are fewer, so that every view is part of a round's mean and opacities can come back after a reset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import torch
from torch import Tensor

from splatnode.recon.optimize.control.control import Change, Step
from splatnode.recon.rasterize.reference import rotations
from splatnode.recon.scene.gaussians import Gaussians, concatenate

NEVER = 2.0  # a share of the iterations that does not come


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    gradient: float = 2e-4  # mean length, from which on there are too few; positions in halves of the image's sides
    every: int = 50  # iterations
    start: float = 500 / 30_000
    end: float = 0.5
    reset_every: float = 0.2  # all opacities become at most `reset_opacity`
    reset_opacity: float = 0.01
    min_opacity: float = 0.005
    small: float = 0.01  # of the extent: up to it Gaussians are doubled, beyond it divided
    largest: float = 0.1  # of the extent, after the first reset
    largest_px: float = 20.0  # three standard deviations in the training views, after the first reset
    shrink: float = 1.6  # by which the parts are smaller than what was divided
    max_gaussians: int = 100_000  # no more are added then


def extent(Ts_world_camera: Sequence[Tensor]) -> float:
    """The size of a scene by its cameras: 1.1 times the largest distance from the mean of their centres."""
    centres = torch.stack([T[:3, 3] for T in Ts_world_camera])
    return 1.1 * float((centres - centres.mean(0)).norm(dim=1).max())


def image_gradient(step: Step) -> Tensor:
    """(N,) length of the gradient with respect to the positions in the image, in halves of its sides.

    From the gradient at the means, as far as these move what is seen: du = f / z dx.
    """
    means, T, target = step.gaussians.means, step.Ts_world_camera[step.view], step.targets[step.view]
    assert means.grad is not None
    z = (means.detach() - T[:3, 3]) @ T[:3, 2]
    across = means.grad @ T[:3, :2] * z[:, None]
    halves = torch.tensor([target.width / 2, target.height / 2]) / torch.diagonal(target.K)[:2]
    return (across * halves).norm(dim=1)


def limit(step: Step, config: Config) -> int:
    """How many Gaussians there may be."""
    return config.max_gaussians if step.max_gaussians is None else min(config.max_gaussians, step.max_gaussians)


def densified(
    gaussians: Gaussians, gradient: Tensor, size: float, most: int, config: Config, generator: torch.Generator
) -> Change:
    """Doubles and divides Gaussians by their mean gradient (N,), in a scene of extent `size`, up to `most` of them."""
    wanting = gradient >= config.gradient
    if len(gaussians) + int(wanting.sum()) > most:
        wanting = torch.zeros_like(wanting)
    large = gaussians.scales.amax(1) > config.small * size
    doubled = gaussians.subset(wanting & ~large)
    divided = gaussians.subset(wanting & large)
    kept = ~(wanting & large)
    parts = [_drawn_from(divided, config.shrink, generator) for _ in range(2)]
    grown = concatenate([gaussians.subset(kept), doubled, *parts])
    rows = torch.nonzero(kept)[:, 0]
    return Change(grown, torch.cat([rows, torch.full((len(grown) - len(rows),), -1)]))


def _drawn_from(gaussians: Gaussians, shrink: float, generator: torch.Generator) -> Gaussians:
    """For each Gaussian a smaller one at a point drawn from it."""
    drawn = torch.randn(gaussians.means.shape, generator=generator) * gaussians.scales
    offset = (rotations(gaussians.quats) @ drawn[..., None])[..., 0]
    return replace(gaussians, means=gaussians.means + offset, log_scales=gaussians.log_scales - math.log(shrink))


def footprint_px(gaussians: Gaussians, step: Step) -> Tensor:
    """(N,) three standard deviations, in pixels, in the training view in which a Gaussian is largest."""
    largest = torch.zeros(len(gaussians))
    for T, target in zip(step.Ts_world_camera, step.targets, strict=True):
        z = (gaussians.means - T[:3, 3]) @ T[:3, 2]
        size = 3.0 * gaussians.scales.amax(1) * float(target.K[0, 0]) / z.clamp_min(1e-6)
        largest = torch.where(z > 0, torch.maximum(largest, size), largest)
    return largest


class AdaptiveControl:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._generator = torch.Generator().manual_seed(seed)
        self._sum = self._count = torch.zeros(0)  # of each Gaussian's gradients since the last round

    def after_step(self, step: Step) -> Change | None:
        config = self._config
        if step.progress > config.end:
            return None
        self._observe(step)
        gaussians = step.gaussians.map(Tensor.detach)
        change = None
        if is_round(step, config):
            mean = self._sum / self._count.clamp_min(1)
            size, most = extent(step.Ts_world_camera), limit(step, config)
            change = densified(gaussians, mean, size, most, config, self._generator)
            change = self._pruned(change, step)
            self._sum = torch.zeros(0)
        if step.iteration % max(1, round(config.reset_every * step.iterations)) == 0:
            change = change or Change(gaussians, torch.arange(len(gaussians)))
            ceiling = math.log(config.reset_opacity / (1 - config.reset_opacity))
            faint = replace(change.gaussians, logit_opacities=change.gaussians.logit_opacities.clamp_max(ceiling))
            change = Change(faint, change.origin)
        return change

    def _observe(self, step: Step) -> None:
        length = image_gradient(step)
        if len(length) != len(self._sum):
            self._sum, self._count = torch.zeros(len(length)), torch.zeros(len(length))
        self._sum += length
        self._count += length > 0

    def _pruned(self, change: Change, step: Step) -> Change:
        config, gaussians = self._config, change.gaussians
        keep = gaussians.opacities >= config.min_opacity
        if step.iteration > config.reset_every * step.iterations:
            keep &= gaussians.scales.amax(1) <= config.largest * extent(step.Ts_world_camera)
            keep &= footprint_px(gaussians, step) <= config.largest_px
        return Change(gaussians.subset(keep), change.origin[keep])


def is_round(step: Step, config: Config) -> bool:
    """Whether Gaussians are added and taken away after this iteration."""
    return config.start <= step.progress <= config.end and step.iteration % config.every == 0


def load(config: Config, seed: int) -> AdaptiveControl:
    return AdaptiveControl(config, seed)
