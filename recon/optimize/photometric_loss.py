"""The photometric loss: L1 + D-SSIM against a fixed photograph, whose part can be computed once."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from splatnode.recon.core import library
from splatnode.recon.optimize import photometric_by_torch
from splatnode.recon.rasterize import dispatch


class PhotometricLoss:
    """(1 - w) * mean |rgb - target| + w * mean (1 - SSIM), w = `ssim_weight`: the loss of 3DGS.

    SSIM has the 11 x 11 Gaussian window of sigma 1.5 and zeros beyond the border. Value and gradient are computed
    together, in float32: in the compiled core, or by torch where the target is on another device than the processor.
    """

    def __init__(
        self, target: Tensor, ssim_weight: float = 0.2, weights: Tensor | None = None, keep_moments: bool = True
    ):
        """`target`: (H, W, 3) in [0, 1]; `weights`: (H, W) >= 0 weigh the pixels of both means, None: all alike.

        The target's moments take twice its memory. Where they are not kept they are computed each time.
        A pixel of weight 0 is ignored: it has no gradient, and in its neighbours' windows it counts as the target's.
        With all weights 0 the loss is 0. Raises ValueError for other shapes and for targets that are not finite.
        """
        if target.dim() != 3 or target.shape[2] != 3 or 0 in target.shape or not target.is_floating_point():
            raise ValueError(f"target must be (H, W, 3) floats, got {tuple(target.shape)} {target.dtype}")
        if not 0 <= ssim_weight <= 1:
            raise ValueError(f"ssim_weight must be from 0 to 1, got {ssim_weight}")
        if weights is not None and weights.shape != target.shape[:2]:
            raise ValueError(f"weights must be {tuple(target.shape[:2])}, got {tuple(weights.shape)}")
        self.ssim_weight = ssim_weight
        self._weights = None if weights is None else weights.detach().to(torch.float32).contiguous()
        self.target = _planar(target.detach())
        if not bool(torch.isfinite(self.target).all()):
            raise ValueError("target must be finite")
        self._on_device: photometric_by_torch.LossWeights | None = None  # where torch computes
        if not dispatch.is_on_cpu(self.target):
            self._on_device = photometric_by_torch.make_weights(self.target, ssim_weight, self._weights)
            return
        pixels = float(target.shape[0] * target.shape[1])
        self._total_weight = pixels if self._weights is None else float(self._weights.sum(dtype=torch.float64))
        self._moments = self._compute_moments() if keep_moments else None

    def __call__(self, rgb: Tensor) -> Tensor:
        """The loss of `rgb` (H, W, 3), scalar."""
        _, height, width = self.target.shape
        if tuple(rgb.shape) != (height, width, 3) or not rgb.is_floating_point():
            raise ValueError(
                f"rgb must be ({height}, {width}, 3) floats as the target, got {tuple(rgb.shape)} {rgb.dtype}"
            )
        return _Photometric.apply(rgb, self)

    def _compute_moments(self) -> tuple[Tensor, Tensor]:
        """Mean and variance of the target in the window of each pixel, both (3, H, W)."""
        mean, variance = torch.empty_like(self.target), torch.empty_like(self.target)
        _, height, width = self.target.shape
        library().core_photometric_moments(_address(self.target), width, height, _address(mean), _address(variance))
        return mean, variance

    def evaluate(self, rgb: Tensor, differentiate: bool) -> tuple[Tensor, Tensor | None]:
        """The loss of `rgb` (H, W, 3), scalar, and its gradient (3, H, W) where it is asked for."""
        if self._on_device is not None:
            image = rgb.to(torch.float32).permute(2, 0, 1)
            value, gradient = photometric_by_torch.evaluate_loss(image, self.target, self._on_device, differentiate)
            return value.to(rgb.dtype), gradient
        planar = _planar(rgb)
        gradient = torch.empty_like(planar) if differentiate else None
        return rgb.new_tensor(self._evaluate_by_core(planar, gradient)), gradient

    def _evaluate_by_core(self, planar: Tensor, gradient: Tensor | None) -> float:
        """The loss of a planar (3, H, W) image; fills `gradient`, of the same shape, where given."""
        _, height, width = self.target.shape
        mean, variance = self._moments or self._compute_moments()
        evaluate = library().core_photometric
        evaluate.restype = ctypes.c_double
        return evaluate(
            _address(planar), _address(self.target), _address(mean), _address(variance),
            _address(self._weights), ctypes.c_double(self._total_weight), ctypes.c_double(self.ssim_weight),
            width, height, _address(gradient),
        )  # fmt: skip


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: Tensor, loss: PhotometricLoss) -> Tensor:
        value, ctx.gradient = loss.evaluate(rgb, ctx.needs_input_grad[0])
        ctx.dtype = rgb.dtype
        return value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        if upstream.device.type != "cpu":  # whose value would have to be waited for
            gradient = ctx.gradient * upstream
        else:
            factor = float(upstream)
            gradient = ctx.gradient if factor == 1 else ctx.gradient * factor
        return gradient.permute(1, 2, 0).to(ctx.dtype), None


def _planar(image: Tensor) -> Tensor:
    return image.to(torch.float32).permute(2, 0, 1).contiguous()


def _address(tensor: Tensor | None) -> ctypes.c_void_p | None:
    return None if tensor is None else ctypes.c_void_p(tensor.data_ptr())
