"""Keyframes through the network together, all at one size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.networks.crop import Crop, crop, crop_image
from splatnode.recon.networks.dinov2 import PATCH, normalize_image
from splatnode.recon.priors.da3.network import DepthEstimate, PlacedCamera


class Network(Protocol):
    """The interface of the prior's network; `DepthAnything3` implements it."""

    def __call__(self, images: Tensor, cameras: Sequence[PlacedCamera] | None = None) -> list[DepthEstimate]: ...


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera of a photograph at full size."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    focal: float  # pixels


@dataclass(frozen=True, eq=False)
class CroppedEstimate:
    """The network's estimate for a keyframe, and the crop that it was made for."""

    estimate: DepthEstimate
    crop: Crop


def estimate_keyframes(
    network: Network, keyframes: Sequence[Keyframe], longer_side: int, cameras: Sequence[KnownCamera] | None = None
) -> list[CroppedEstimate]:
    """Runs the network on these keyframes together; images are cropped to a common size."""
    crops = [crop(keyframe.frame.width, keyframe.frame.height, longer_side, PATCH) for keyframe in keyframes]
    width, height = min(each.width for each in crops), min(each.height for each in crops)
    crops = [each.crop_centre(width, height) for each in crops]
    images = [
        normalize_image(crop_image(keyframe.frame.image, to)) for keyframe, to in zip(keyframes, crops, strict=True)
    ]
    placed = None if cameras is None else [_place_camera(camera, to) for camera, to in zip(cameras, crops, strict=True)]
    estimates = network(torch.stack(images), placed)
    return [CroppedEstimate(estimate, to) for estimate, to in zip(estimates, crops, strict=True)]


def _place_camera(camera: KnownCamera, to: Crop) -> PlacedCamera:
    """Makes the cropped image's camera, with a central principal point, as the network assumes."""
    focal = camera.focal * to.scale
    K = np.array([[focal, 0.0, to.width / 2], [0.0, focal, to.height / 2], [0.0, 0.0, 1.0]])
    return PlacedCamera(camera.T_world_camera, K)
