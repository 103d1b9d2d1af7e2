"""Takes away Gaussians without which the photographs would look the same: those that explain less than they cost."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import torch
from torch import Tensor

from recon.background import SOURCE_FRAME as SHELL
from recon.control.control import Change, Step
from recon.density import REFERENCE_PX
from recon.gaussians import Gaussians
from recon.rasterize.cpu import rasterize
from recon.target import Target


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    at: tuple[float, ...] = (0.5,)  # when this part of the refinement is done, rising
    least_change: float = 0.06  # squared difference of colours in [0, 1], summed over all pixels, channels and views
    probes: int = 4  # random images a view from which the differences are estimated


def load(config: Config, seed: int) -> Pruning:
    return Pruning(config, seed)


class Pruning:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._generator = torch.Generator().manual_seed(seed)
        self._due = list(config.at)

    def after_step(self, step: Step) -> Change | None:
        if not self._due or step.progress < self._due[0]:
            return None
        while self._due and step.progress >= self._due[0]:
            self._due.pop(0)
        gaussians = step.gaussians.map(Tensor.detach)
        worth = changes_without(gaussians, step.Ts_world_camera, step.targets, self._config.probes, self._generator)
        # What the photographs do not show is what the far shell is for.
        worth[gaussians.source_frame == SHELL] = torch.inf
        kept = most_worth(worth, self._config.least_change, step.max_gaussians)
        return Change(gaussians.subset(kept), kept)


def most_worth(worth: Tensor, least: float, limit: int | None) -> Tensor:
    """The indices, rising, of what is worth at least that much; of these the best where they are more than `limit`."""
    kept = (worth >= least).nonzero()[:, 0]
    if limit is not None and len(kept) > limit:
        kept = worth.topk(limit).indices.sort().values
    return kept


def changes_without(
    gaussians: Gaussians,
    Ts_world_camera: Sequence[Tensor],
    targets: Sequence[Target],
    probes: int,
    generator: torch.Generator,
) -> Tensor:
    """(N,) the squared difference that it makes to all photographs together if one Gaussian is left out: an estimate.

    What a pixel shows is linear in each opacity, so that leaving a Gaussian out changes it by opacity * derivative.
    The sum over pixels of these squares is the mean square of their sum with random signs (Hutchinson 1990), which
    costs no more than a gradient. Pixels count as if the photographs were REFERENCE_PX wide.
    """
    opacities = gaussians.opacities.requires_grad_(True)
    total = torch.zeros(len(gaussians))
    for T_world_camera, target in zip(Ts_world_camera, targets, strict=True):
        size = (REFERENCE_PX / max(target.width, target.height)) ** 2
        rgb = rasterize(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            opacities,
            gaussians.sh,
            T_world_camera,
            target.K,
            target.width,
            target.height,
            channels=("rgb",),
        ).rgb
        assert rgb is not None  # it was asked for
        for _ in range(probes):
            signs = torch.randint(0, 2, rgb.shape, generator=generator) * 2.0 - 1.0
            (gradient,) = torch.autograd.grad(rgb, opacities, signs, retain_graph=True)
            total += size * (gradient * opacities.detach()) ** 2
    return total / probes
