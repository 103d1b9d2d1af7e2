"""Local depth regularisation: the rendered depth must rise and fall with the known one, patch by patch."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def pearson(x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
    """(M,) weighted correlation of the rows of x and y (M, P), in [-1, 1] (equation 8). A constant row gives 0.

    Correlation does not see scale and offset, so a monocular depth serves as well as a metric one.
    """
    total = weights.sum(1, keepdim=True).clamp_min(1e-12)
    x = x - (weights * x).sum(1, keepdim=True) / total
    y = y - (weights * y).sum(1, keepdim=True) / total
    covariance = (weights * x * y).sum(1)
    product = (weights * x * x).sum(1) * (weights * y * y).sum(1)
    return covariance / (product + 1e-16).sqrt()


def local_depth_loss(
    depth: Tensor, truth: Tensor, weights: Tensor, *, patch: int, share: float, generator: torch.Generator
) -> Tensor:
    """Mean of 1 - correlation over M patches drawn from the L that tile the image (equation 9); 0 where they agree.

    `depth`, `truth` and `weights` are (H, W); a weight of 0 leaves a pixel out. M is `share` of the patches of `patch`
    x `patch` pixels in which at least half of the pixels are known and the known depth is not flat to one part in a
    thousand: rounding has no shape to correlate with. Without any the loss is 0, with a gradient of 0.
    """
    if depth.shape != truth.shape or depth.shape != weights.shape or depth.dim() != 2:
        raise ValueError(
            f"depth, truth and weights must be (H, W), got {tuple(depth.shape)}, {tuple(truth.shape)} and "
            f"{tuple(weights.shape)}"
        )
    rows, known, weighed = (tiles(image, patch) for image in (depth, truth, weights))
    usable = torch.nonzero(((weighed > 0).float().mean(1) >= 0.5) & (_relative_spread(known, weighed) > 1e-3))[:, 0]
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
    total = weights.sum(1).clamp_min(1e-12)
    mean = (weights * rows).sum(1) / total
    variance = (weights * (rows - mean[:, None]) ** 2).sum(1) / total
    return variance.sqrt() / mean.abs().clamp_min(1e-12)
