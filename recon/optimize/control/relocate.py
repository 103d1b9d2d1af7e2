"""3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024) at a fixed number of Gaussians: a rival of our sizes.

Those that have become transparent move to others, chosen by opacity, so that the picture stays as it is; all but the
opaque ones are shaken, the more the larger they are. Constants are those of the authors' code, but that relocation
starts at once: a scene begins with a Gaussian wherever stereo saw a surface.
"""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import torch
from torch import Tensor

from splatnode.recon.optimize.control.control import Change, Step
from splatnode.recon.rasterize.reference import rotations
from splatnode.recon.scene.gaussians import Gaussians

MOST_IN_ONE_PLACE = 51  # of the authors' tables


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    every: int = 100  # iterations between relocations
    until: float = 0.83  # part of the refinement after which nothing is relocated: 25000 of 30000 iterations
    dead: float = 0.005  # opacity up to which a Gaussian is moved
    noise: float = 5e5  # times the step size of the means times the covariance
    rate: float = 1.6e-4  # that step size at the start, and
    final: float = 0.01  # the part of it that is left at the end


def load(config: Config, seed: int) -> Relocation:
    return Relocation(config, seed)


class Relocation:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._generator = torch.Generator().manual_seed(seed)

    def after_step(self, step: Step) -> Change:
        config = self._config
        gaussians = step.gaussians.map(Tensor.detach)
        origin = torch.arange(len(gaussians))
        if step.iteration % config.every == 0 and step.progress < config.until:
            gaussians, origin = relocated(gaussians, config.dead, self._generator)
        size = config.noise * config.rate * config.final**step.progress
        return Change(shaken(gaussians, size, self._generator), origin)


def relocated(gaussians: Gaussians, dead: float, generator: torch.Generator) -> tuple[Gaussians, Tensor]:
    """The Gaussians with each dead one beside a living one, and (N,) whose moments each goes on with; -1: new."""
    opacities = gaussians.opacities
    gone = (opacities <= dead).nonzero()[:, 0]
    alive = (opacities > dead).nonzero()[:, 0]
    origin = torch.arange(len(gaussians))
    if not len(gone) or not len(alive):
        return gaussians, origin
    chosen = alive[torch.multinomial(opacities[alive], len(gone), replacement=True, generator=generator)]
    together = torch.bincount(chosen, minlength=len(gaussians)).clamp(max=MOST_IN_ONE_PLACE - 1) + 1
    source = origin.clone()
    source[gone] = chosen
    touched = together[source] > 1
    shared, narrower = divided(opacities[source][touched], together[source][touched])
    moved = gaussians.subset(source)
    logits, log_scales = moved.logit_opacities.clone(), moved.log_scales.clone()
    logits[touched] = torch.logit(shared.clamp(dead, 1 - 1e-6))
    log_scales[touched] += narrower.log()[:, None]
    return replace(moved, logit_opacities=logits, log_scales=log_scales), torch.where(touched, -1, origin)


def divided(opacities: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and relative extent (M,) of each of `counts` Gaussians that together look like one (equation 9)."""
    shared = 1 - (1 - opacities) ** (1 / counts)
    total = torch.zeros_like(opacities)
    for i in range(1, int(counts.max()) + 1):
        for k in range(i):
            term = math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * shared.double() ** (k + 1)
            total = total + torch.where(counts >= i, term, 0.0).float()
    return shared, opacities / total


def shaken(gaussians: Gaussians, size: float, generator: torch.Generator) -> Gaussians:
    """The Gaussians moved by `size` times their covariance times normal noise, where they are transparent."""
    transparent = torch.sigmoid(-100.0 * (gaussians.opacities - 0.005))
    axes = rotations(gaussians.quats) * gaussians.scales[:, None, :]
    normal = torch.randn(gaussians.means.shape, generator=generator) * transparent[:, None]
    moves = size * (axes @ (axes.transpose(1, 2) @ normal[:, :, None]))[:, :, 0]
    return replace(gaussians, means=gaussians.means + moves)
