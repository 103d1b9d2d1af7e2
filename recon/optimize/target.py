"""Target: a photograph that is rendered again, at one resolution."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.optimize.photometric_loss import PhotometricLoss
from splatnode.recon.scene.scene import TrainingView


@dataclass(frozen=True, eq=False)
class Target:
    K: Tensor  # (3, 3) for the image at this size
    width: int
    height: int
    loss: PhotometricLoss  # with the photograph as its target, where it shows the scene


def target(view: TrainingView, shown: npt.NDArray[np.bool_], scale: float, dssim: float) -> Target:
    """The photograph of `view` at `scale` of its size; `dssim` weighs the two parts of the loss.

    Only pixels that are `shown` (h, w) entirely are compared.
    """
    K, width, height = scaled(view.K, view.width, view.height, scale)
    image, weights = view.image, None
    if (width, height) != (view.width, view.height):
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    if not shown.all():
        share = cv2.resize(shown.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        weights = torch.from_numpy(np.floor(share + np.float32(1e-3)))
    return Target(K, width, height, PhotometricLoss(torch.from_numpy(image).float() / 255.0, dssim, weights))


def scaled(K: Tensor, width: int, height: int, scale: float) -> tuple[Tensor, int, int]:
    """Intrinsics, width and height of the same view at `scale` of its resolution."""
    scaled_width, scaled_height = max(1, round(width * scale)), max(1, round(height * scale))
    sizes = torch.tensor([[scaled_width / width], [scaled_height / height], [1.0]])
    return K.float() * sizes, scaled_width, scaled_height
