"""Point-rendered perceptual loss: a pseudo view must look as the point cloud does from there (equations 6, 7)."""

from __future__ import annotations

import torch
from torch import Tensor

from splatnode.capture.process.config import Internal
from splatnode.recon.optimize.losses import Loss, Schedule
from splatnode.recon.optimize.photometric_losses import load_perceptual
from splatnode.recon.optimize.regularizers import Supervision
from splatnode.recon.rasterize.reference import Render


class Config(Schedule, frozen=True, forbid_unknown_fields=True):
    # Pull pixels without a point towards white, as the paper writes; else leave them out
    compare_unseen: Internal[bool] = False


def prepare(config: Config, supervision: Supervision, seed: int) -> Loss:
    """LPIPS, or its stand-in without weights, between render and point render of each pseudo view."""
    perceptual = load_perceptual()
    renders = supervision.point_renders
    distances = [perceptual.prepare_distance(torch.from_numpy(shown.rgb)) for shown in renders]
    seen = [torch.from_numpy(shown.seen)[..., None] for shown in renders]

    def evaluate_pseudo_view(index: int, render: Render) -> Tensor:
        assert render.rgb is not None  # it was asked for
        rgb = render.rgb if config.compare_unseen else torch.where(seen[index], render.rgb, 1.0)
        return distances[index](rgb)

    return Loss(perceptual.name, on_pseudo_view=evaluate_pseudo_view)
