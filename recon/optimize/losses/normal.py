"""Normal regularisation: rendered normals must point where the known ones do (equation 10)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatnode.recon.optimize.losses import Evaluate, Loss, Schedule
from splatnode.recon.optimize.regularizers import Supervision, SurfaceTarget, resample_target
from splatnode.recon.rasterize.reference import Render

_MIN_SQUARED_LENGTH = 1e-6  # of a rendered normal: thinner coverage has no direction
_MIN_WEIGHT = 1e-12  # least divisor, where nothing is known


class Config(Schedule, frozen=True, forbid_unknown_fields=True):
    """The normal loss has no settings of its own."""


def prepare(config: Config, supervision: Supervision, seed: int) -> Loss:
    """The normal loss on training views and pseudo views."""

    def against(targets: Sequence[SurfaceTarget]) -> Evaluate:
        def evaluate(index: int, render: Render) -> Tensor:
            assert render.normal is not None  # it was asked for
            target = targets[index]
            truth, weights = (
                resample_target(target.normal, render.normal),
                resample_target(target.weights, render.normal),
            )
            return normal_loss(render.normal, truth, weights)

        return evaluate

    return Loss(
        f"normals of the {supervision.depth_source}",
        ("normal",),
        on_training_view=against(supervision.surfaces),
        on_pseudo_view=against(supervision.pseudo_surfaces),
    )


def normal_loss(normal: Tensor, truth: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean of |N - N'|_1 + |1 - N . N'| (equation 10, as a mean over pixels); 0 where they agree.

    `normal` (H, W, 3) is rendered, a sum of weighted normals as the rasteriser gives it: it is brought to unit length,
    so that thin coverage costs nothing here. `truth` (H, W, 3) has unit length; `weights` (H, W) of 0 leave a pixel
    out. The paper writes a sum; with the mean its weight does not depend on the size of the image.
    """
    if normal.shape != truth.shape or normal.shape[:2] != weights.shape or normal.shape[2:] != (3,):
        raise ValueError(
            f"normals must be (H, W, 3) and weights (H, W), got {tuple(normal.shape)}, {tuple(truth.shape)} and "
            f"{tuple(weights.shape)}"
        )
    squared_length = (normal * normal).sum(-1, keepdim=True)
    covered = weights * (squared_length[..., 0].detach() > _MIN_SQUARED_LENGTH)
    unit = normal / torch.where(squared_length > _MIN_SQUARED_LENGTH, squared_length, 1.0).sqrt()
    pixels = (unit - truth).abs().sum(-1) + (1.0 - (unit * truth).sum(-1)).abs()
    return (covered * pixels).sum() / covered.sum().clamp_min(_MIN_WEIGHT)
