"""How much two images differ. Images are (H, W, 3) in [0, 1]."""

from __future__ import annotations

import torch
from torch import Tensor

from splatnode.recon.optimize import photometric_reference
from splatnode.recon.scene.light import SATURATED


def psnr(image: Tensor, truth: Tensor, used: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB, for a peak of 1; at most 100, which equal images get.

    `used` (H, W) says which pixels count; None: all.
    """
    _check_same_shape(image, truth)
    squares = (image.double() - truth.double()) ** 2
    error = torch.mean(squares if used is None else squares[used])
    return float(-10.0 * torch.log10(error.clamp(min=1e-10)))


def ssim(image: Tensor, truth: Tensor) -> float:
    """Structural similarity (Wang et al. 2004) as the 3DGS code defines it, so that figures compare.

    An 11x11 Gaussian window of sigma 1.5 in each colour channel, zeros beyond the border, biased variances; the mean
    over all pixels and channels, 1 for equal images.
    """
    _check_same_shape(image, truth)
    return float(photometric_reference.ssim(image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)).mean())


def _check_same_shape(image: Tensor, truth: Tensor) -> None:
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"images must both be (H, W, 3), got {tuple(image.shape)} and {tuple(truth.shape)}")


def fit_gains(truth: Tensor, image: Tensor, used: Tensor) -> Tensor:
    """(3,) by which `image` fits `truth` best, both (H, W, 3), in each channel, where `used` (H, W) says so.

    What is white in `truth` may have been brighter, and does not count; where nothing does, the gain is 1.
    """
    told = used[..., None] & (truth < SATURATED / 255.0)
    seen, known = image * told, truth * told
    squares = (seen * seen).sum((0, 1))
    fitting = (seen * known).sum((0, 1)) / squares.clamp_min(1e-12)
    return torch.where(squares > 0, fitting, 1.0).clamp_min(1e-3)
