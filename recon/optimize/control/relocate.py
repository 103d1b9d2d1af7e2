"""3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024), at a fixed number of Gaussians: a rival at our sizes.

Dead Gaussians, which have become transparent, are relocated to live ones, drawn by opacity, so that the render stays
the same; noise is added to the means of all but opaque ones, in proportion to their covariance. Constants are those of
the authors' code, except that relocation starts at once: a scene is seeded wherever stereo knows a surface.
"""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import torch
from torch import Tensor

from splatnode.capture.process.config import Internal
from splatnode.recon.optimize.control import GaussianChange, OptimizerStep
from splatnode.recon.rasterize.reference import compute_rotations
from splatnode.recon.scene import Gaussians

MAX_COPIES = 51  # of one Gaussian, itself included: the size of the authors' tables
_SHARPNESS = 100.0  # of the sigmoid of the opacity by which noise is weighed
_TRANSPARENT = 0.005  # opacity at which that weight is one half
_ALMOST_OPAQUE = 1 - 1e-6  # largest opacity that is given: the logit of 1 is infinite


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    every: Internal[int] = 100  # iterations between relocations
    until: Internal[float] = 0.83  # share of the refinement after which nothing is relocated: 25000 of 30000 iterations
    dead: Internal[float] = 0.005  # opacity up to which a Gaussian is relocated
    noise: Internal[float] = 5e5  # amplitude of the noise on positions, in learning rates of the means
    rate: Internal[float] = 1.6e-4  # that learning rate at the start
    final: Internal[float] = 0.01  # part of that rate that is left at the end, after an exponential fall


def load(config: Config, seed: int) -> Relocation:
    return Relocation(config, seed)


class Relocation:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._generator = torch.Generator().manual_seed(seed)

    def after_step(self, step: OptimizerStep) -> GaussianChange:
        config = self._config
        gaussians = step.gaussians.map(Tensor.detach)
        origin = torch.arange(len(gaussians), device=gaussians.means.device)
        if step.iteration % config.every == 0 and step.progress < config.until:
            gaussians, origin = relocate_dead(gaussians, config.dead, self._generator)
        size = config.noise * config.rate * config.final**step.progress
        return GaussianChange(add_noise(gaussians, size, self._generator), origin)


def relocate_dead(gaussians: Gaussians, dead: float, generator: torch.Generator) -> tuple[Gaussians, Tensor]:
    """The Gaussians with each dead one moved to a live one, and (N,) `GaussianChange.origin`.

    Those that now share a place look together as the live one did.
    """
    opacities = gaussians.opacities
    dead_rows = (opacities <= dead).nonzero()[:, 0]
    alive = (opacities > dead).nonzero()[:, 0]
    origin = torch.arange(len(gaussians), device=opacities.device)
    if not len(dead_rows) or not len(alive):
        return gaussians, origin
    weights = opacities[alive].cpu()  # where random numbers are drawn
    drawn = alive[torch.multinomial(weights, len(dead_rows), replacement=True, generator=generator).to(alive.device)]
    copies = torch.bincount(drawn, minlength=len(gaussians)).clamp(max=MAX_COPIES - 1) + 1
    source = origin.clone()
    source[dead_rows] = drawn
    changed = copies[source] > 1
    opacity, relative_scale = split_opacity(copies[source][changed], opacities[source][changed])
    moved = gaussians.subset(source)
    logits, log_scales = moved.logit_opacities.clone(), moved.log_scales.clone()
    logits[changed] = torch.logit(opacity.clamp(dead, _ALMOST_OPAQUE))
    log_scales[changed] += relative_scale.log()[:, None]
    return replace(moved, logit_opacities=logits, log_scales=log_scales), torch.where(changed, -1, origin)


def split_opacity(copies: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity, and scale relative to the one that is shared (M,), of each of `copies` that together look like one.

    `copies` and `opacities` are (M,); equation 9 of the paper.
    """
    shared = 1 - (1 - opacities) ** (1 / copies)
    total = torch.zeros_like(opacities)
    for i in range(1, int(copies.max()) + 1):
        for k in range(i):
            term = math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * shared.double() ** (k + 1)
            total = total + torch.where(copies >= i, term, 0.0).float()
    return shared, opacities / total


def add_noise(gaussians: Gaussians, size: float, generator: torch.Generator) -> Gaussians:
    """The Gaussians with their means moved by `size` times covariance times normal noise, less the more opaque."""
    weight = torch.sigmoid(-_SHARPNESS * (gaussians.opacities - _TRANSPARENT))
    axes = compute_rotations(gaussians.quats) * gaussians.scales[:, None, :]
    noise = torch.randn(gaussians.means.shape, generator=generator).to(weight.device) * weight[:, None]
    moves = size * (axes @ (axes.transpose(1, 2) @ noise[:, :, None]))[:, :, 0]
    return replace(gaussians, means=gaussians.means + moves)
