"""TrainingImage: the photograph of a view at the resolution at which its render is compared with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.optimize.photometric_loss import PhotometricLoss
from splatnode.recon.scene.scene import TrainingView

_PROCESSOR = torch.device("cpu")
_WHOLLY_SHOWN = 1e-3  # tolerance on the share of a pixel that shows the scene, above the rounding of the resize


@dataclass(frozen=True, eq=False)
class TrainingImage:
    K: Tensor  # (3, 3) intrinsics at this size, pixels
    width: int  # pixels
    height: int
    loss: Callable[[Tensor], Tensor]  # of a render (height, width, 3), against the photograph where it shows the scene


@dataclass(frozen=True, eq=False)
class _AtLeastSoBright:
    """The loss of a photograph that is saturated in places: a render that is brighter there is right."""

    loss: PhotometricLoss
    target: Tensor  # (height, width, 3) the photograph
    saturated: Tensor  # (height, width, 3) bool

    def __call__(self, rgb: Tensor) -> Tensor:
        return self.loss(torch.where(self.saturated, torch.minimum(rgb, self.target), rgb))


def training_image(
    view: TrainingView,
    shown: npt.NDArray[np.bool_],
    scale: float,
    dssim: float,
    device: torch.device = _PROCESSOR,
    keep_moments: bool = True,
) -> TrainingImage:
    """The photograph of `view` at `scale` of its size, with `dssim` the weight of D-SSIM in its loss.

    The photograph lies, and the loss is computed, on `device`: that of the Gaussians which are rendered. `keep_moments`
    is the loss's.

    `shown` (h, w), at the photograph's own size, is False on the black border that undistortion leaves. A pixel of the
    smaller image is compared only if all pixels that it covers are shown.
    """
    K, width, height = scaled(view.K, view.width, view.height, scale)
    image, weights = view.image, None
    if (width, height) != (view.width, view.height):
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    if not shown.all():
        share = cv2.resize(shown.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        weights = torch.from_numpy(np.floor(share + np.float32(_WHOLLY_SHOWN))).to(device)
    target = torch.tensor(image, device=device).float() / 255.0  # a copy: what is read from a file is read-only
    loss = PhotometricLoss(target, dssim, weights, keep_moments)
    if view.exposure is None or view.exposure.saturated is None:
        return TrainingImage(K, width, height, loss)
    share = cv2.resize(view.exposure.saturated.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    saturated = torch.from_numpy(share > 0).to(device)
    return TrainingImage(K, width, height, _AtLeastSoBright(loss, target, saturated))


def scaled(K: Tensor, width: int, height: int, scale: float) -> tuple[Tensor, int, int]:
    """Intrinsics, width and height of the same view at `scale` of its resolution."""
    scaled_width, scaled_height = max(1, round(width * scale)), max(1, round(height * scale))
    factors = torch.tensor([[scaled_width / width], [scaled_height / height], [1.0]])
    return K.float() * factors, scaled_width, scaled_height
