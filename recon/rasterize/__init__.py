"""Differentiable rasterisers behind one interface: the core on the processor, elsewhere gsplat and torch.

`reference.py` is the definition.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from splatnode.recon.rasterize import gsplat
from splatnode.recon.rasterize.reference import CHANNELS, NEAR, Render, check_input
from splatnode.recon.result.rendering import (
    CHANNEL_BITS,
    RasterGradients,
    RasterImages,
    make_raster_input,
    raster_forward,
)
from splatnode.recon.scene import Gaussians

# The rasteriser on the processor: autograd around the compiled core (recon/core).
#
# It computes in float32. Values agree with the reference to about 1e-5 and gradients to about 1e-4 of their norm.
# Where an alpha is within rounding of 1/255, or a pixel's transmittance of 1e-4, the two may decide differently; that
# moves a pixel by at most 1/255 of one splat's colour. The result does not depend on the number of threads.


def rasterize_on_cpu(
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


# Who computes with Gaussians: the core where their tensors are on the processor, elsewhere gsplat and torch.


def is_on_cpu(tensor: Tensor) -> bool:
    """Whether the compiled core computes with this tensor."""
    return tensor.device.type == "cpu"


def rasterize(means: Tensor, *further: Any, **options: Any) -> Render:
    """The image of the Gaussians on the device of `means`; arguments and result are those of `rasterize_on_cpu`.

    `gsplat.rasterize` says where the two differ. The camera may be on another device than the Gaussians are.
    """
    return (rasterize_on_cpu if is_on_cpu(means) else gsplat.rasterize)(means, *further, **options)


def make_rasterizer(device: torch.device) -> Callable[..., Render]:
    """A `rasterize` that computes on `device` and takes and gives tensors on the processor. It can be pickled."""
    return rasterize if device.type == "cpu" else partial(_rasterize_on, device)


def _rasterize_on(device: torch.device, means: Tensor, *further: Any, **options: Any) -> Render:
    tensors = (each.to(device) if isinstance(each, Tensor) else each for each in further)
    return rasterize(means.to(device), *tensors, **options).move_to_device(torch.device("cpu"))


# Renders of a scene's Gaussians, as the optimiser and its tests ask for them.


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion."""

    T_world_camera: Tensor  # (4, 4)
    K: Tensor  # (3, 3), pixels; the centre of the top-left pixel is at (0.5, 0.5)
    width: int  # pixels
    height: int


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    channels: Collection[str] = ("rgb",),  # fields of Render
    *,
    opacities: Tensor | None = None,  # (N,) in [0, 1], in place of the Gaussians' own
) -> Render:
    """The Gaussians as `camera` sees them, with gradients, on their own device; see `recon.rasterize`."""
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities if opacities is None else opacities,
        gaussians.sh,
        camera.T_world_camera,
        camera.K,
        camera.width,
        camera.height,
        channels=channels,
    )


# The device that a scene is refined on: what the configuration asks for, held against what there is.

Device = Literal["cpu", "cuda", "auto"]  # auto: cuda where it can be used, else cpu


class DeviceUnavailable(RuntimeError):
    """The device that was asked for cannot be used here."""

    exit_code = 69


def choose_device(wanted: Device) -> torch.device:
    """The device to compute on. Raises DeviceUnavailable for a GPU that cannot be used, with the reason."""
    if wanted == "cpu":
        return torch.device("cpu")
    obstacle = gsplat.find_unavailable_reason()
    if obstacle is None:
        return torch.device("cuda")
    if wanted == "cuda":
        raise DeviceUnavailable(
            f"device cuda needs an NVIDIA GPU that torch and gsplat can use, but {obstacle}. "
            "Take device auto or cpu to go on without it; `splatnode doctor` tells what there is"
        )
    return torch.device("cpu")


def format_device(wanted: Device, device: torch.device) -> str:
    """One line about `chosen(wanted)`, for the log."""
    if device.type == "cuda":
        return f"scenes are refined on {torch.cuda.get_device_name(device)}, by gsplat"
    return "scenes are refined on the processor" + (f": {gsplat.find_unavailable_reason()}" if wanted == "auto" else "")
