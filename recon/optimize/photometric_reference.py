"""What the photometric loss is, in PyTorch: the core equals it, and so does what serves on other devices."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

WINDOW, _SIGMA = 11, 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2


def photometric_loss(
    rgb: Tensor,  # (H, W, 3)
    target: Tensor,  # (3, H, W)
    ssim_weight: float,
    weights: Tensor | None = None,  # (H, W) of the pixels, in both means; None: all alike
) -> Tensor:
    """(1 - ssim_weight) * mean |rgb - target| + ssim_weight * mean (1 - SSIM), scalar, with gradients.

    Pixels of weight 0 count as the target's in their neighbours' windows. With all weights 0 the loss is 0.
    """
    image = rgb.permute(2, 0, 1)
    if weights is None:
        weights = torch.ones_like(target[0])
    image = torch.where(weights > 0, image, target)
    per_pixel = ((1 - ssim_weight) * (image - target).abs() + ssim_weight * (1 - ssim(image, target))).mean(0)
    total = weights.sum()
    return (weights * per_pixel).sum() / torch.where(total > 0, total, 1)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """(3, H, W) structural similarity (Wang et al. 2004) of images (3, H, W) in [0, 1], as the 3DGS code defines it.

    An 11 x 11 Gaussian window of sigma 1.5 in each colour, zeros beyond the border, biased variances.
    """
    products = torch.stack([image, target, image * image, target * target, image * target])
    mean, target_mean, squared, target_squared, product = _blur(products)
    variance, target_variance = squared - mean**2, target_squared - target_mean**2
    covariance = product - mean * target_mean
    return ((2 * mean * target_mean + C1) * (2 * covariance + C2)) / (
        (mean**2 + target_mean**2 + C1) * (variance + target_variance + C2)
    )


def _blur(images: Tensor) -> Tensor:
    """(M, 3, H, W) under the normalised Gaussian window, which is separable, with zeros beyond the border."""
    weights = window(images.dtype, images.device)
    planes = images.flatten(0, 1)[:, None]
    rows = functional.conv2d(planes, weights.view(1, 1, 1, -1), padding=(0, WINDOW // 2))
    return functional.conv2d(rows, weights.view(1, 1, -1, 1), padding=(WINDOW // 2, 0)).view_as(images)


def window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(11,) the weights of neighbours in a row, which is also those in a column."""
    offsets = torch.arange(WINDOW, dtype=dtype, device=device) - WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    return weights / weights.sum()
