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

from splatnode.recon.optimize import pseudo_views
from splatnode.recon.rasterize.gaussian_render import Camera, render_gaussians
from splatnode.recon.scene.scene import Scene, TrainingView


class EnsembleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    members: Annotated[int, Meta(ge=1)] = 1  # scenes that are refined; 1: that one, and nothing after it
    # Steps of the refinement after them, on photographs as often as on pseudo views; nothing is pruned any more
    iterations: Annotated[int, Meta(ge=1)] = 400
    rates: Annotated[float, Meta(gt=0, le=1)] = 0.3  # its step sizes of Gaussians, of those in `optimize.rates`
    pseudo_views: Annotated[int, Meta(ge=1)] = 6  # for each photograph; at most as many as there are steps on them
    off_path: Annotated[float, Meta(ge=0)] = 0.3  # their largest distance from the cameras' path, in its steps


def seed_of(member: int, seed: int) -> int:
    """Returns the seed of a member; the first one's is that of a scene by itself."""
    return seed if member == 0 else int(np.random.SeedSequence((seed, member)).generate_state(1)[0])


@torch.no_grad()
def render_between_views(members: Sequence[Scene], config: EnsembleConfig, seed: int) -> list[TrainingView]:
    """Views between the cameras of the first of the members: what they show there in the mean. None of one camera."""
    views, rng = members[0].views, np.random.default_rng(seed)
    count = min(config.pseudo_views * len(views), math.ceil(config.iterations / 2))
    found = pseudo_views.sample_pseudo_views(views, count, off_path=config.off_path, rng=rng)
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
