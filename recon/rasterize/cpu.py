"""The rasteriser on the processor: autograd around the compiled core (recon/core).

It computes in float32. Values agree with the reference to about 1e-5 and gradients to about 1e-4 of their norm. Where
an alpha is within rounding of 1/255, or a pixel's transmittance of 1e-4, the two may decide differently; that moves a
pixel by at most 1/255 of one splat's colour. The result does not depend on the number of threads.
"""

from __future__ import annotations

import ctypes
from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor

from splatnode.recon.rasterize.native import (
    CHANNEL_BITS,
    RasterGradients,
    RasterImages,
    make_raster_input,
    raster_forward,
)
from splatnode.recon.rasterize.reference import CHANNELS, NEAR, Render, check_input


def rasterize(
    means: Tensor,  # (N, 3) world
    quats: Tensor,  # (N, 4) wxyz, any length but zero
    scales: Tensor,  # (N, 3) world units
    opacities: Tensor,  # (N,) in [0, 1]
    sh: Tensor,  # (N, B, 3) with B = 1, 4, 9 or 16
    T_world_camera: Tensor,  # (4, 4) rigid
    K: Tensor,  # (3, 3)
    width: int,
    height: int,
    *,
    channels: Collection[str] = CHANNELS,
    antialias: bool = False,
    near: float = NEAR,
) -> Render:
    """The image of the Gaussians, as `recon.rasterize.reference.rasterize` defines it, in float32.

    Channels that are not asked for, or that no gradient comes back to, cost nothing. The colour and normal images are
    views of planar memory (3, H, W). Raises ValueError where the input is not what it must be, values included.
    """
    check_input(means, quats, scales, opacities, sh, T_world_camera, K, width, height, channels, near, "cpu")
    parameters = (tensor.to(torch.float32).contiguous() for tensor in (means, quats, scales, opacities, sh))
    settings = (width, height, frozenset(channels), antialias, near)
    rgb, depth, normal, alpha = _Rasterize.apply(*parameters, T_world_camera, K, settings)
    return Render(rgb, depth, normal, alpha)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, sh, T_world_camera, K, settings):
        width, height, channels, antialias, near = settings
        source = make_raster_input(
            means.shape[0],
            sh.shape[1],
            [tensor.data_ptr() for tensor in (means, quats, scales, opacities, sh)],
            T_world_camera.flatten().tolist(),
            K.flatten().tolist(),
            width,
            height,
            channels,
            antialias,
            near,
        )
        rgb, depth, normal = (
            means.new_empty(shape) if name in channels else None
            for name, shape in (("rgb", (3, height, width)), ("depth", (height, width)), ("normal", (3, height, width)))
        )
        alpha = means.new_empty(height, width)
        raster = raster_forward(source, RasterImages(*map(_address, (rgb, depth, normal, alpha))))

        ctx.source, ctx.raster = source, raster
        ctx.save_for_backward(means, quats, scales, opacities, sh, depth, alpha)
        ctx.camera_like = T_world_camera.detach(), K.detach()
        ctx.set_materialize_grads(False)
        shown_alpha = alpha if "alpha" in channels else None
        return _channels_last(rgb), depth, _channels_last(normal), shown_alpha

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *image_gradients):  # pyright: ignore[reportIncompatibleMethodOverride]
        means, quats, scales, opacities, sh, depth, alpha = ctx.saved_tensors
        planar = [_planar(gradient) for gradient in image_gradients]
        channels = sum(bit for bit, gradient in zip(CHANNEL_BITS.values(), planar, strict=True) if gradient is not None)
        if not channels:
            return (None,) * 8
        parameters = [torch.empty_like(tensor) for tensor in (means, quats, scales, opacities, sh)]
        gradients = RasterGradients(*map(_address, parameters))
        ctx.raster.core.core_raster_backward(
            ctypes.byref(ctx.source),
            ctx.raster.handle,
            channels,
            ctypes.byref(RasterImages(None, _address(depth), None, _address(alpha))),
            ctypes.byref(RasterImages(*map(_address, planar))),
            ctypes.byref(gradients),
        )
        T_world_camera, K = (torch.zeros_like(tensor) for tensor in ctx.camera_like)
        T_world_camera += torch.tensor(list(gradients.T_world_camera), dtype=torch.float64).view(4, 4)
        (fx, fy), (cx, cy) = gradients.focal, gradients.principal
        K += torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 0]], dtype=torch.float64)
        return *parameters, T_world_camera, K, None


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _channels_last(planar: Tensor | None) -> Tensor | None:
    return None if planar is None else planar.permute(1, 2, 0)


def _planar(image: Tensor | None) -> Tensor | None:
    if image is None:
        return None
    planar = image.permute(2, 0, 1) if image.dim() == 3 else image
    return planar.to(torch.float32).contiguous()
