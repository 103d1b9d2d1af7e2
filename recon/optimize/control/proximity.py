"""Proximity-guided Gaussian unpooling of FSGS (Zhu et al. 2024, section 3.2), after adaptive density control.

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

from splatnode.capture.process.config import Internal
from splatnode.recon.optimize.control import GaussianChange, OptimizerStep, adaptive
from splatnode.recon.scene import Gaussians, concatenate


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    adaptive: Internal[adaptive.Config] = adaptive.Config()
    neighbours: Internal[int] = 3  # nearest Gaussians to which a distance is measured
    # Mean distance to them, in extents of the scene, above which Gaussians are added; the paper gives no unit
    min_distance: Internal[float] = 0.05


def unpool(gaussians: Gaussians, min_distance: float, neighbours: int) -> Gaussians:
    """The new Gaussians, half-way from each whose mean distance to its `neighbours` is above `min_distance` to these.

    The distance is in units of the world.
    """
    if len(gaussians) <= neighbours:
        return gaussians.subset(torch.zeros(0, dtype=torch.long))
    means = gaussians.means.cpu().numpy()
    found = KDTree(means).query(means, neighbours + 1)
    device = gaussians.means.device
    distances, nearest = (torch.from_numpy(np.asarray(each)[:, 1:]).to(device) for each in found)  # itself comes first
    isolated = distances.mean(1) > min_distance
    source = torch.nonzero(isolated)[:, 0].repeat_interleave(neighbours)
    destination = nearest[isolated].flatten()
    grown = gaussians.subset(destination)
    identity = torch.zeros_like(grown.quats)
    identity[:, 0] = 1.0
    return replace(
        grown,
        means=(gaussians.means[source] + gaussians.means[destination]) / 2,
        quats=identity,
        source_frame=gaussians.source_frame[source],
    )


class ProximityControl:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._adaptive = adaptive.load(config.adaptive, seed)

    def after_step(self, step: OptimizerStep) -> GaussianChange | None:
        change = self._adaptive.after_step(step)
        if change is None or not adaptive.is_round(step, self._config.adaptive):
            return change
        min_distance = self._config.min_distance * adaptive.extent(step.Ts_world_camera)
        grown = unpool(change.gaussians, min_distance, self._config.neighbours)
        if len(change.gaussians) + len(grown) > adaptive.limit(step, self._config.adaptive):
            return change
        fresh: Tensor = change.origin.new_full((len(grown),), -1)
        return GaussianChange(concatenate([change.gaussians, grown]), torch.cat([change.origin, fresh]))


def load(config: Config, seed: int) -> ProximityControl:
    return ProximityControl(config, seed)
