"""What the photometric loss is, in PyTorch: the core equals it, and it serves on other devices than the processor."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


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
    mean, target_mean, squared, target_squared, product = _blurred(products)
    variance, target_variance = squared - mean**2, target_squared - target_mean**2
    covariance = product - mean * target_mean
    return ((2 * mean * target_mean + _C1) * (2 * covariance + _C2)) / (
        (mean**2 + target_mean**2 + _C1) * (variance + target_variance + _C2)
    )


def _blurred(images: Tensor) -> Tensor:
    """(M, 3, H, W) under the normalised Gaussian window, which is separable, with zeros beyond the border."""
    offsets = torch.arange(_WINDOW, dtype=images.dtype, device=images.device) - _WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    window = window / window.sum()
    planes = images.flatten(0, 1)[:, None]
    rows = functional.conv2d(planes, window.view(1, 1, 1, -1), padding=(0, _WINDOW // 2))
    return functional.conv2d(rows, window.view(1, 1, -1, 1), padding=(_WINDOW // 2, 0)).view_as(images)
