"""Local depth regularisation: rendered and known depth must rise and fall together, patch by patch (equations 8, 9)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from splatnode.capture.process.config import Internal
from splatnode.recon.optimize.losses import Evaluate, Loss, Schedule
from splatnode.recon.optimize.regularizers import Supervision, SurfaceTarget, resample_target
from splatnode.recon.rasterize.reference import Render

_MIN_KNOWN = 0.5  # share of a patch's pixels whose depth is known
_MIN_RELATIVE_SPREAD = 1e-3  # standard deviation over mean of a patch's known depth: rounding has no shape to follow
_TINY = 1e-12  # least divisor, where a sum of weights or a mean may be 0
_TINY_PRODUCT = 1e-16  # of two variances, likewise


class Config(Schedule, frozen=True, forbid_unknown_fields=True):
    """The loss of LM-Gaussian, which leaves the size of the patches open.

    On sceaux, in 250 iterations, the depth loss alone cost .38 dB with patches of 32 pixels, in which often noise is
    all that rises and falls, and .11 dB with 128.
    """

    patch: int = 128  # side of a patch, pixels
    share: Internal[float] = 0.5  # share of the patches that is drawn, anew at each iteration


def prepare(config: Config, supervision: Supervision, seed: int) -> Loss:
    """The local depth loss on training views and pseudo views; `seed` says which patches are drawn."""
    generator = torch.Generator().manual_seed(seed)

    def against(targets: Sequence[SurfaceTarget]) -> Evaluate:
        def evaluate(index: int, render: Render) -> Tensor:
            assert render.depth is not None  # it was asked for
            truth, weights = (resample_target(t, render.depth) for t in (targets[index].depth, targets[index].weights))
            patch, share = config.patch, config.share
            return local_depth_loss(render.depth, truth, weights, patch=patch, share=share, generator=generator)

        return evaluate

    return Loss(
        supervision.depth_source,
        ("depth",),
        on_training_view=against(supervision.surfaces),
        on_pseudo_view=against(supervision.pseudo_surfaces),
    )


def pearson(x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
    """(M,) weighted correlation of the rows of x and y (M, P), in [-1, 1] (equation 8). A constant row gives 0.

    Correlation does not see scale and offset, so a monocular depth serves as well as a metric one.
    """
    total = weights.sum(1, keepdim=True).clamp_min(_TINY)
    x = x - (weights * x).sum(1, keepdim=True) / total
    y = y - (weights * y).sum(1, keepdim=True) / total
    covariance = (weights * x * y).sum(1)
    product = (weights * x * x).sum(1) * (weights * y * y).sum(1)
    return covariance / (product + _TINY_PRODUCT).sqrt()


def local_depth_loss(
    depth: Tensor, truth: Tensor, weights: Tensor, *, patch: int, share: float, generator: torch.Generator
) -> Tensor:
    """Mean of 1 - correlation over M patches drawn from the L that tile the image (equation 9); 0 where they agree.

    `depth`, `truth` and `weights` are (H, W); a weight of 0 leaves a pixel out. M is `share` of the patches of `patch`
    x `patch` pixels in which at least half of the pixels are known and the known depth is not flat to one part in a
    thousand. Without any the loss is 0, with a gradient of 0.
    """
    if depth.shape != truth.shape or depth.shape != weights.shape or depth.dim() != 2:
        raise ValueError(
            f"depth, truth and weights must be (H, W), got {tuple(depth.shape)}, {tuple(truth.shape)} and "
            f"{tuple(weights.shape)}"
        )
    rows, known, weighed = (tiles(image, patch) for image in (depth, truth, weights))
    mostly_known = (weighed > 0).float().mean(1) >= _MIN_KNOWN
    usable = torch.nonzero(mostly_known & (_relative_spread(known, weighed) > _MIN_RELATIVE_SPREAD))[:, 0]
    count = math.ceil(share * len(usable))
    drawn = usable[torch.randperm(len(usable), generator=generator)[:count]]
    if count == 0:
        return 0.0 * depth.sum()
    return (1.0 - pearson(rows[drawn], known[drawn], weighed[drawn])).mean()


def tiles(image: Tensor, size: int) -> Tensor:
    """(L, size * size): the patches that tile an image (H, W) from its top left corner; what is left over is not used.

    An image smaller than a patch is one patch.
    """
    height, width = image.shape
    tall, wide = min(size, height), min(size, width)
    cropped = image[: height // tall * tall, : width // wide * wide]
    return cropped.unflatten(1, (-1, wide)).unflatten(0, (-1, tall)).transpose(1, 2).flatten(2).flatten(0, 1)


def _relative_spread(rows: Tensor, weights: Tensor) -> Tensor:
    """(M,) weighted standard deviation of each row (M, P) over its weighted mean."""
    total = weights.sum(1).clamp_min(_TINY)
    mean = (weights * rows).sum(1) / total
    variance = (weights * (rows - mean[:, None]) ** 2).sum(1) / total
    return variance.sqrt() / mean.abs().clamp_min(_TINY)
