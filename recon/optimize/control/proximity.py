"""Gaussian unpooling of FSGS (Zhu et al. 2024, section 3.2), beside adaptive density control.

Few photographs give few points, far apart. A Gaussian whose nearest neighbours are far away gets new ones half-way to
each of them, with the neighbour's size and opacity.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from splatnode.recon.optimize.control import adaptive
from splatnode.recon.optimize.control.control import Change, Step
from splatnode.recon.scene.gaussians import Gaussians, concatenate


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    adaptive: adaptive.Config = adaptive.Config()
    neighbours: int = 3
    far: float = 0.05  # mean distance to them, in parts of the scene's extent; published in units that are not given


def unpooled(gaussians: Gaussians, far: float, neighbours: int) -> Gaussians:
    """The new Gaussians between each whose `neighbours` are further than `far` in the mean, and these."""
    if len(gaussians) <= neighbours:
        return gaussians.subset(torch.zeros(0, dtype=torch.long))
    found = KDTree(gaussians.means.numpy()).query(gaussians.means.numpy(), neighbours + 1)
    distances, nearest = (torch.from_numpy(np.asarray(each))[:, 1:] for each in found)  # itself comes first
    lonely = distances.mean(1) > far
    source = torch.nonzero(lonely)[:, 0].repeat_interleave(neighbours)
    target = nearest[lonely].flatten()
    grown = gaussians.subset(target)
    turned = torch.zeros_like(grown.quats)
    turned[:, 0] = 1.0
    return replace(
        grown,
        means=(gaussians.means[source] + gaussians.means[target]) / 2,
        quats=turned,
        source_frame=gaussians.source_frame[source],
    )


class ProximityControl:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._adaptive = adaptive.load(config.adaptive, seed)

    def after_step(self, step: Step) -> Change | None:
        change = self._adaptive.after_step(step)
        if change is None or not adaptive.is_round(step, self._config.adaptive):
            return change
        far = self._config.far * adaptive.extent(step.Ts_world_camera)
        grown = unpooled(change.gaussians, far, self._config.neighbours)
        if len(change.gaussians) + len(grown) > adaptive.limit(step, self._config.adaptive):
            return change
        fresh: Tensor = torch.full((len(grown),), -1)
        return Change(concatenate([change.gaussians, grown]), torch.cat([change.origin, fresh]))


def load(config: Config, seed: int) -> ProximityControl:
    return ProximityControl(config, seed)
