"""Test-pose optimisation: the search for a test image's camera in a finished scene, which stays as it is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from splatnode.recon.evaluate.appearance import Appearance
from splatnode.recon.geometry import exp_se3, twist_gradient

Array = npt.NDArray[np.float64]

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-12  # of Adam (Kingma and Ba 2015)


@dataclass(frozen=True, eq=False)
class FoundPose:
    T_world_camera: Array  # (4, 4)
    loss: float  # mean absolute difference to the image


def find_test_pose(
    scene: Appearance,
    image: Tensor,  # (H, W, 3) in [0, 1]
    T_world_camera: Array,  # (4, 4) where the search starts
    K: Array,  # (3, 3) of `image`
    *,
    steps: int,
    levels: int = 1,
    learning_rate: float = 0.003,
    final: float = 0.01,  # the share of it that is left of the learning rate at the end
    used: Tensor | None = None,  # (H, W) where the image is compared; None: everywhere
) -> FoundPose:
    """Equation 18: the pose from which the frozen scene looks most like the image, in mean absolute difference.

    Adam moves a twist at the current pose, with a learning rate that falls exponentially (on a view of fountain_p11,
    120 steps of it found what 500 steps of InstantSplat's cosine found). The best pose seen is returned, never one
    worse than the start. `learning_rate` is in radians, and for the translation in parts of the scene's depth, so that
    both move the image by similar amounts in a world without scale. With `levels` > 1 the steps are shared between
    resolutions that double up to the image's own, which widens the basin and needs more of them. Raises ValueError for
    steps or levels below 1.
    """
    if steps < 1 or levels < 1:
        raise ValueError(f"steps and levels must be at least 1, got {steps} and {levels}")
    start = torch.from_numpy(np.ascontiguousarray(T_world_camera, np.float64))
    units = torch.ones(6, dtype=torch.float64)
    units[:3] = scene.depth(T_world_camera)
    first, second = torch.zeros(6, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)  # Adam's moments

    T, best_T, best_loss = start, start, math.inf
    for step in range(steps):
        level = step * levels // steps
        reduced = _downsample_inputs(image, K, used, 2 ** (levels - 1 - level))
        loss, gradient = _loss_and_gradient(scene, T, *reduced)
        if level == levels - 1 and loss < best_loss:
            best_T, best_loss = T, loss
        slope = twist_gradient(T, gradient) * units
        first = _BETA1 * first + (1 - _BETA1) * slope
        second = _BETA2 * second + (1 - _BETA2) * slope**2
        unbiased = first / (1 - _BETA1 ** (step + 1)), second / (1 - _BETA2 ** (step + 1))
        rate = learning_rate * final ** (step / steps)
        # The moments live in the camera's own frame, which turns with it: each step is a twist at the current pose.
        T = T @ exp_se3(-rate * unbiased[0] / (unbiased[1].sqrt() + _EPSILON) * units)
    for candidate in (T, start):
        loss, _ = _loss_and_gradient(scene, candidate, image, torch.from_numpy(K), used)
        if loss < best_loss:
            best_T, best_loss = candidate, loss
    return FoundPose(best_T.numpy(), best_loss)


def _loss_and_gradient(
    scene: Appearance, T_world_camera: Tensor, image: Tensor, K: Tensor, used: Tensor | None
) -> tuple[float, Tensor]:
    """The mean absolute difference, and its gradient (4, 4) with respect to the pose alone."""
    T = T_world_camera.to(image).requires_grad_()
    loss = scene.difference(image, T, K.to(image), used)
    (gradient,) = torch.autograd.grad(loss, T)
    return float(loss.detach()), gradient.double()


def _downsample_inputs(
    image: Tensor, K: Array, used: Tensor | None, factor: int
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The image area-resampled by 1 / `factor`, its K, and where it is compared."""
    height, width = image.shape[:2]
    size = max(1, round(height / factor)), max(1, round(width / factor))
    ratios = torch.tensor([size[1] / width, size[0] / height, 1.0], dtype=torch.float64)
    if size != (height, width):
        image = functional.interpolate(image.permute(2, 0, 1)[None], size=size, mode="area")[0].permute(1, 2, 0)
        used = None if used is None else _downsample_mask(used, size)
    return image, torch.from_numpy(K) * ratios[:, None], used


def _downsample_mask(used: Tensor, size: tuple[int, int]) -> Tensor:
    """Pixels of which all is used; where there are none, those of which anything is."""
    share = functional.interpolate(used.float()[None, None], size=size, mode="area")[0, 0]
    whole = share > 0.999
    return whole if whole.any() else share > 0
