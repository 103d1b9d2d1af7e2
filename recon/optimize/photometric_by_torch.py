"""The photometric loss and its gradient in closed form, in PyTorch, for other devices than the processor.

There each operation is a launch, which takes longer than what it computes. So sums and differences are compared: with
s = image + target, d = image - target, the blur B, S = (B s)^2, D = (B d)^2, and their variances V = B[s^2] - S,
W = B[d^2] - D, SSIM is (S - D + 2 C1) / (S + D + 2 C1) times (V - W + 2 C2) / (V + W + 2 C2). Both factors are one
expression of two pairs, and so are their derivatives. The blur is its own transpose.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from splatnode.recon.optimize.photometric_reference import C1, C2, WINDOW, window


@dataclass(frozen=True, eq=False)
class LossWeights:
    """The weights of the loss's two parts in each pixel of each colour, (H, W) each."""

    difference: Tensor  # of the absolute difference
    dissimilarity: Tensor  # of 1 - SSIM
    shown: Tensor | None  # False where a pixel is to be taken for the target's; None: nowhere


def make_weights(target: Tensor, ssim_weight: float, weights: Tensor | None) -> LossWeights:
    """Makes the weights of a loss against `target` (3, H, W) with pixel `weights` (H, W); None: all alike."""
    given = torch.ones_like(target[0]) if weights is None else weights.to(target.dtype)
    total = given.sum()
    unit = given / (3 * torch.where(total > 0, total, 1))
    return LossWeights((1 - ssim_weight) * unit, ssim_weight * unit, None if weights is None else given > 0)


@torch.no_grad()
def evaluate_loss(
    image: Tensor, target: Tensor, weights: LossWeights, differentiate: bool = True
) -> tuple[Tensor, Tensor]:
    """The loss, scalar, and its gradient (3, H, W), a view of (H, W, 3), of an image and a target (3, H, W).

    Not to be differentiated, the gradient may be anything.
    """
    if weights.shown is not None:
        image = torch.where(weights.shown, image, target)
    both = image.new_empty(4, *image.shape)  # s, d, and their squares
    torch.add(image, target, out=both[0])
    torch.sub(image, target, out=both[1])
    torch.mul(both[:2], both[:2], out=both[2:])
    blurred = _blur(both)
    pairs = image.new_empty(2, 2, *image.shape)  # S and D, V and W
    torch.mul(blurred[:2], blurred[:2], out=pairs[0])
    torch.sub(blurred[2:], pairs[0], out=pairs[1])
    pairs[:, 0].add_(_constants(image.dtype, image.device))
    below = pairs[:, 0] + pairs[:, 1]
    ratios = (pairs[:, 0] - pairs[:, 1]) / below
    dissimilarity = torch.addcmul(weights.dissimilarity, ratios[0], ratios[1] * weights.dissimilarity, value=-1)
    signs = both[1].sgn() * weights.difference
    value = torch.addcmul(dissimilarity, signs, both[1]).sum()
    if not differentiate:
        return value, image
    # By S, D, V and W, halved: of what the other factor is multiplied by.
    others = ratios.flip(0) / below * weights.dissimilarity
    derivatives = pairs
    torch.mul(others, ratios, out=derivatives[:, 0])
    torch.add(others, derivatives[:, 0], out=derivatives[:, 1])
    derivatives[:, 0].sub_(others)
    derivatives[0].sub_(derivatives[1]).mul_(blurred[:2])
    back = _blur(derivatives.flatten(0, 1))
    by_both = torch.addcmul(back[:2], both[:2], back[2:])
    gradient = torch.add(by_both[0], by_both[1])
    if weights.shown is not None:
        gradient.mul_(weights.shown)
    channels_last = torch.empty_like(gradient.permute(1, 2, 0), memory_format=torch.contiguous_format).permute(2, 0, 1)
    return value, torch.add(signs, gradient, alpha=2, out=channels_last)


def _blur(images: Tensor) -> Tensor:
    """(M, 3, H, W) under the window, with zeros beyond the border.

    Each plane is a channel of its own: torch has kernels for that, which compute in full precision.
    """
    planes = images.flatten(0, 1)[None]
    count = planes.shape[1]
    across, down = _windows(count, images.dtype, images.device)
    rows = functional.conv2d(planes, across, padding=(0, WINDOW // 2), groups=count)
    return functional.conv2d(rows, down, padding=(WINDOW // 2, 0), groups=count).view_as(images)


@lru_cache(maxsize=8)
def _windows(count: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    weights = window(dtype, device).expand(count, 1, -1)
    return weights[:, :, None, :].contiguous(), weights[:, :, :, None].contiguous()


@lru_cache(maxsize=8)
def _constants(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor([2 * C1, 2 * C2], dtype=dtype, device=device).view(2, 1, 1, 1)
