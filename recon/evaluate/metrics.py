"""How much two images differ. Images are (H, W, 3) in [0, 1]."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(image: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB, for a peak of 1; at most 100, which equal images get."""
    _check_same_shape(image, truth)
    error = torch.mean((image.double() - truth.double()) ** 2)
    return float(-10.0 * torch.log10(error.clamp(min=1e-10)))


def ssim(image: Tensor, truth: Tensor) -> float:
    """Structural similarity (Wang et al. 2004) as the 3DGS code defines it, so that figures compare.

    An 11x11 Gaussian window of sigma 1.5 in each colour channel, zeros beyond the border, biased variances; the mean
    over all pixels and channels, 1 for equal images.
    """
    _check_same_shape(image, truth)
    x, y = image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = _blur(torch.stack([x, y, x * x, y * y, x * y])).unbind(0)
    variance_x, variance_y = mean_xx - mean_x**2, mean_yy - mean_y**2
    covariance = mean_xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2 * covariance + _C2) / (variance_x + variance_y + _C2)
    return float((luminance * structure).mean())


def _blur(images: Tensor) -> Tensor:
    """(M, 3, H, W) after the window, which is separable."""
    offsets = torch.arange(_WINDOW, dtype=images.dtype, device=images.device) - _WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    window = window / window.sum()
    flat = images.reshape(-1, 1, *images.shape[-2:])
    flat = functional.conv2d(flat, window.view(1, 1, -1, 1), padding=(_WINDOW // 2, 0))
    flat = functional.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, _WINDOW // 2))
    return flat.reshape(images.shape)


def _check_same_shape(image: Tensor, truth: Tensor) -> None:
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"images must both be (H, W, 3), got {tuple(image.shape)} and {tuple(truth.shape)}")
