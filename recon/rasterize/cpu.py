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

from recon.core import library
from recon.rasterize.check import check_input
from recon.rasterize.reference import CHANNELS, NEAR
from recon.rasterize.render import Render

_CHANNEL_BITS = {"rgb": 1, "depth": 2, "normal": 4, "alpha": 8}
_INPUT_ERRORS = {
    1: "means must be finite",
    2: "quats must be finite and not of zero length",
    4: "scales must be finite and not negative (pass log_scales.exp())",
    8: "opacities must be from 0 to 1 (pass logit_opacities.sigmoid())",
    16: "sh must be finite",
    32: "the Gaussians cover more than 2^31 tiles of 32 x 32 pixels: there are too many or their scales are too large",
}
STAGES = ("project", "bin", "blend", "blend_backward", "project_backward")


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
    settings = (width, height, sum(_CHANNEL_BITS[name] for name in set(channels)), antialias, near)
    rgb, depth, normal, alpha = _Rasterize.apply(*parameters, T_world_camera, K, settings)
    return Render(rgb, depth, normal, alpha)


class _Input(ctypes.Structure):
    """RasterInput of recon/core/rasterize.h."""

    _fields_ = [
        *((name, ctypes.c_int32) for name in ("num_gaussians", "sh_bases", "width", "height", "antialias", "channels")),
        ("near_plane", ctypes.c_float),
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "sh")),
        ("T_world_camera", ctypes.c_double * 16),
        ("focal", ctypes.c_double * 2),
        ("principal", ctypes.c_double * 2),
    ]


class _Images(ctypes.Structure):
    """RasterImages of recon/core/rasterize.h."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("rgb", "depth", "normal", "alpha")]


class _Gradients(ctypes.Structure):
    """RasterGradients of recon/core/rasterize.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "sh")),
        ("T_world_camera", ctypes.c_double * 16),
        ("focal", ctypes.c_double * 2),
        ("principal", ctypes.c_double * 2),
    ]


class _Raster:
    """What the core keeps of a rendered view for its gradient. Gives it back when nothing refers to it any more."""

    def __init__(self, core: ctypes.CDLL, handle: ctypes.c_void_p):
        self.core = core
        self.handle = handle

    def __del__(self):
        self.core.core_raster_release(self.handle)

    def seconds(self) -> tuple[dict[str, float], dict[str, float]]:
        """By stage, of the last forward and backward: seconds on the clock, and of all processors together."""
        values = (ctypes.c_double * (2 * len(STAGES)))()
        self.core.core_raster_seconds(self.handle, values)
        clock, processors = values[: len(STAGES)], values[len(STAGES) :]
        return dict(zip(STAGES, clock, strict=True)), dict(zip(STAGES, processors, strict=True))


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, sh, T_world_camera, K, settings):
        width, height, channels, antialias, near = settings
        source = _Input(
            means.shape[0], sh.shape[1], width, height, antialias, channels, near,
            *(tensor.data_ptr() for tensor in (means, quats, scales, opacities, sh)),
            (ctypes.c_double * 16)(*T_world_camera.flatten().tolist()),
            (ctypes.c_double * 2)(float(K[0, 0]), float(K[1, 1])),
            (ctypes.c_double * 2)(float(K[0, 2]), float(K[1, 2])),
        )  # fmt: skip
        rgb, depth, normal = (
            means.new_empty(shape) if channels & _CHANNEL_BITS[name] else None
            for name, shape in (("rgb", (3, height, width)), ("depth", (height, width)), ("normal", (3, height, width)))
        )
        alpha = means.new_empty(height, width)
        raster = _forward(source, _Images(*map(_address, (rgb, depth, normal, alpha))))

        ctx.source, ctx.raster = source, raster
        ctx.save_for_backward(means, quats, scales, opacities, sh, depth, alpha)
        ctx.camera_like = T_world_camera.detach(), K.detach()
        ctx.set_materialize_grads(False)
        shown_alpha = alpha if channels & _CHANNEL_BITS["alpha"] else None
        return _channels_last(rgb), depth, _channels_last(normal), shown_alpha

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *image_gradients):  # pyright: ignore[reportIncompatibleMethodOverride]
        means, quats, scales, opacities, sh, depth, alpha = ctx.saved_tensors
        planar = [_planar(gradient) for gradient in image_gradients]
        channels = sum(
            bit for bit, gradient in zip(_CHANNEL_BITS.values(), planar, strict=True) if gradient is not None
        )
        if not channels:
            return (None,) * 8
        parameters = [torch.empty_like(tensor) for tensor in (means, quats, scales, opacities, sh)]
        gradients = _Gradients(*map(_address, parameters))
        ctx.raster.core.core_raster_backward(
            ctypes.byref(ctx.source),
            ctx.raster.handle,
            channels,
            ctypes.byref(_Images(None, _address(depth), None, _address(alpha))),
            ctypes.byref(_Images(*map(_address, planar))),
            ctypes.byref(gradients),
        )
        T_world_camera, K = (torch.zeros_like(tensor) for tensor in ctx.camera_like)
        T_world_camera += torch.tensor(list(gradients.T_world_camera), dtype=torch.float64).view(4, 4)
        (fx, fy), (cx, cy) = gradients.focal, gradients.principal
        K += torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 0]], dtype=torch.float64)
        return *parameters, T_world_camera, K, None


def _forward(source: _Input, images: _Images) -> _Raster:
    core = library()
    handle = ctypes.c_void_p()
    errors = core.core_raster_forward(ctypes.byref(source), ctypes.byref(images), ctypes.byref(handle))
    if errors:
        raise ValueError("; ".join(message for bit, message in _INPUT_ERRORS.items() if errors & bit))
    return _Raster(core, handle)


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _channels_last(planar: Tensor | None) -> Tensor | None:
    return None if planar is None else planar.permute(1, 2, 0)


def _planar(image: Tensor | None) -> Tensor | None:
    if image is None:
        return None
    planar = image.permute(2, 0, 1) if image.dim() == 3 else image
    return planar.to(torch.float32).contiguous()
