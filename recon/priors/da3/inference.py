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
from splatnode.recon.networks.crop import Crop, crop, cropped
from splatnode.recon.networks.dinov2 import PATCH, normalised
from splatnode.recon.priors.da3.network import Estimate, PlacedCamera


class Network(Protocol):
    """What the prior needs of a network; `DepthAnything3` is one."""

    def __call__(self, images: Tensor, cameras: Sequence[PlacedCamera] | None = None) -> list[Estimate]: ...


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera of a photograph at full size."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    focal: float  # pixels


@dataclass(frozen=True, eq=False)
class Answer:
    """What the network says of a keyframe, and how that was cropped for it."""

    estimate: Estimate
    crop: Crop


def ask(
    network: Network, keyframes: Sequence[Keyframe], longer_side: int, cameras: Sequence[KnownCamera] | None = None
) -> list[Answer]:
    """What the network says of these keyframes together; photographs of different shapes are cut to what all have."""
    crops = [crop(keyframe.frame.width, keyframe.frame.height, longer_side, PATCH) for keyframe in keyframes]
    width, height = min(each.width for each in crops), min(each.height for each in crops)
    crops = [each.cut(width, height) for each in crops]
    images = [normalised(cropped(keyframe.frame.image, to)) for keyframe, to in zip(keyframes, crops, strict=True)]
    placed = None if cameras is None else [_placed(camera, to) for camera, to in zip(cameras, crops, strict=True)]
    estimates = network(torch.stack(images), placed)
    return [Answer(estimate, to) for estimate, to in zip(estimates, crops, strict=True)]


def _placed(camera: KnownCamera, to: Crop) -> PlacedCamera:
    """With the principal point in the middle, as the network has it."""
    focal = camera.focal * to.scale
    K = np.array([[focal, 0.0, to.width / 2], [0.0, focal, to.height / 2], [0.0, 0.0, 1.0]])
    return PlacedCamera(camera.T_world_camera, K)
