"""TrainingImage: the photograph of a view at the resolution at which its render is compared with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.optimize.losses.perceptual import LpipsDistance
from splatnode.recon.optimize.photometric_losses import PhotometricLoss, perceptual_loss
from splatnode.recon.scene.scene import TrainingView

_PROCESSOR = torch.device("cpu")
_PRIOR = 0.1  # weight of a gain of 1 against what a render and its photograph say, of what exposure is left
_WHOLLY_SHOWN = 1e-3  # tolerance on the share of a pixel that shows the scene, above the rounding of the resize


@dataclass(frozen=True, eq=False)
class TrainingImage:
    K: Tensor  # (3, 3) intrinsics at this size, pixels
    width: int  # pixels
    height: int
    # Of a render (height, width, 3), against the photograph where that shows the scene
    loss: Callable[[Tensor], Tensor]  # photometric
    perceptual: Callable[[Tensor], Tensor] | None = None  # None: there is no network for it


@dataclass(frozen=True, eq=False)
class _ExposureCompensatedLoss:
    """A loss against a photograph whose exposure was taken out.

    A tone curve is no gain, so a part of the exposure is left in it: a gain a channel, the one that fits the render
    best, under the prior that it is 1. Where the photograph is saturated, a render that is brighter is right.
    """

    loss: Callable[[Tensor], Tensor]
    target: Tensor  # (height, width, 3) the photograph
    told: Tensor  # (height, width, 3) bool: False where it is saturated, or does not show the scene
    prior: Tensor  # (3,) as much as _PRIOR of the photograph, squared

    def __call__(self, rgb: Tensor) -> Tensor:
        rgb = rgb * self._gains(rgb.detach())
        return self.loss(torch.where(self.told, rgb, torch.minimum(rgb, self.target)))

    def _gains(self, rgb: Tensor) -> Tensor:
        """(3,) in closed form; 1 for a channel of which the photograph tells nothing but black."""
        seen = rgb * self.told
        known = (seen * self.target).sum((0, 1)) + self.prior
        gains = known / ((seen * seen).sum((0, 1)) + self.prior).clamp_min(1e-12)
        return torch.where(self.prior > 0, gains, 1.0)


def make_training_image(
    view: TrainingView,
    shown: npt.NDArray[np.bool_],
    scale: float,
    dssim: float,
    device: torch.device = _PROCESSOR,
    keep: bool = True,
    measure: LpipsDistance | None = None,
) -> TrainingImage:
    """The photograph of `view` at `scale` of its size, with `dssim` the weight of D-SSIM in its photometric loss.

    The photograph lies, and the losses are computed, on `device`: that of the Gaussians which are rendered, where the
    network of `measure`, for the perceptual loss, has to be, too. `keep`: whether what the losses compute of the
    photograph is kept.

    `shown` (h, w), at the photograph's own size, is False on the black border that undistortion leaves. A pixel of the
    smaller image is compared only if all pixels that it covers are shown.
    """
    K, width, height = scale_intrinsics(view.K, view.width, view.height, scale)
    image, weights = view.image, None
    if (width, height) != (view.width, view.height):
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    if not shown.all():
        share = cv2.resize(shown.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        weights = torch.from_numpy(np.floor(share + np.float32(_WHOLLY_SHOWN))).to(device)
    target = torch.tensor(image, device=device).float() / 255.0  # a copy: what is read from a file is read-only
    loss = PhotometricLoss(target, dssim, weights, keep)
    perceptual = perceptual_loss(measure, target, weights, keep)
    if view.exposure is None:
        return TrainingImage(K, width, height, loss, perceptual)
    told = torch.ones_like(target, dtype=torch.bool) if weights is None else (weights > 0)[..., None].expand_as(target)
    if view.exposure.saturated is not None:
        share = cv2.resize(view.exposure.saturated.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        told = told & torch.from_numpy(share == 0).to(device)
    known = target * told
    prior = _PRIOR * (known * known).sum((0, 1))
    exposed = partial(_ExposureCompensatedLoss, target=target, told=told, prior=prior)
    return TrainingImage(K, width, height, exposed(loss), perceptual and exposed(perceptual))


def scale_intrinsics(K: Tensor, width: int, height: int, scale: float) -> tuple[Tensor, int, int]:
    """Intrinsics, width and height of the same view at `scale` of its resolution."""
    scaled_width, scaled_height = max(1, round(width * scale)), max(1, round(height * scale))
    factors = torch.tensor([[scaled_width / width], [scaled_height / height], [1.0]])
    return K.float() * factors, scaled_width, scaled_height
