"""Normal regularisation: the rendered normals must point where the known ones do."""

from __future__ import annotations

import torch
from torch import Tensor


def normal_loss(normal: Tensor, truth: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean of |N - N'|_1 + |1 - N . N'| (equation 10, as a mean over pixels); 0 where they agree.

    `normal` (H, W, 3) is rendered, a sum of weighted normals as the rasteriser gives it: it is brought to unit length,
    so that thin coverage is not punished here. `truth` (H, W, 3) has unit length; `weights` (H, W) of 0 leave a pixel
    out. The paper writes a sum; with the mean its weight does not depend on the size of the image.
    """
    if normal.shape != truth.shape or normal.shape[:2] != weights.shape or normal.shape[2:] != (3,):
        raise ValueError(
            f"normals must be (H, W, 3) and weights (H, W), got {tuple(normal.shape)}, {tuple(truth.shape)} and "
            f"{tuple(weights.shape)}"
        )
    length = (normal * normal).sum(-1, keepdim=True)
    covered = weights * (length[..., 0].detach() > 1e-6)
    unit = normal / torch.where(length > 1e-6, length, 1.0).sqrt()
    pixels = (unit - truth).abs().sum(-1) + (1.0 - (unit * truth).sum(-1)).abs()
    return (covered * pixels).sum() / covered.sum().clamp_min(1e-12)
