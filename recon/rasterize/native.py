"""The C interface of the compiled rasteriser (recon/core/rasterize.h), for NumPy and torch alike: it needs neither."""

from __future__ import annotations

import ctypes
from collections.abc import Collection, Sequence

from splatnode.recon.core import library

CHANNEL_BITS = {"rgb": 1, "depth": 2, "normal": 4, "alpha": 8}
STAGES = ("project", "bin", "blend", "blend_backward", "project_backward")
_INPUT_ERRORS = {
    1: "means must be finite",
    2: "quats must be finite and not of zero length",
    4: "scales must be finite and not negative (pass log_scales.exp())",
    8: "opacities must be from 0 to 1 (pass logit_opacities.sigmoid())",
    16: "sh must be finite",
    32: "the Gaussians cover more than 2^31 tiles of 32 x 32 pixels: there are too many or their scales are too large",
}


class RasterInput(ctypes.Structure):
    """RasterInput of recon/core/rasterize.h."""

    _fields_ = [
        *((name, ctypes.c_int32) for name in ("num_gaussians", "sh_bases", "width", "height", "antialias", "channels")),
        ("near_plane", ctypes.c_float),
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "sh")),
        ("T_world_camera", ctypes.c_double * 16),
        ("focal", ctypes.c_double * 2),
        ("principal", ctypes.c_double * 2),
    ]


class RasterImages(ctypes.Structure):
    """RasterImages of recon/core/rasterize.h."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("rgb", "depth", "normal", "alpha")]


class RasterGradients(ctypes.Structure):
    """RasterGradients of recon/core/rasterize.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "sh")),
        ("T_world_camera", ctypes.c_double * 16),
        ("focal", ctypes.c_double * 2),
        ("principal", ctypes.c_double * 2),
    ]


class Raster:
    """The core's state of a rendered view, for its gradient. It is released with its last reference."""

    def __init__(self, core: ctypes.CDLL, handle: ctypes.c_void_p):
        self.core = core
        self.handle = handle

    def __del__(self):
        self.core.core_raster_release(self.handle)

    def seconds(self) -> tuple[dict[str, float], dict[str, float]]:
        """Returns seconds by stage of the last forward and backward: wall clock, and summed over processors."""
        values = (ctypes.c_double * (2 * len(STAGES)))()
        self.core.core_raster_seconds(self.handle, values)
        clock, processors = values[: len(STAGES)], values[len(STAGES) :]
        return dict(zip(STAGES, clock, strict=True)), dict(zip(STAGES, processors, strict=True))


def make_raster_input(
    num_gaussians: int,
    sh_bases: int,
    addresses: Sequence[int],  # of means, quats, scales, opacities and sh: float32, contiguous, alive while it is used
    T_world_camera: Sequence[float],  # 16, row by row
    K: Sequence[float],  # 9, row by row
    width: int,
    height: int,
    channels: Collection[str],
    antialias: bool,
    near: float,
) -> RasterInput:
    """The input of `raster_forward`. Nothing is checked."""
    bits = sum(CHANNEL_BITS[name] for name in set(channels))
    return RasterInput(
        num_gaussians, sh_bases, width, height, antialias, bits, near, *addresses,
        (ctypes.c_double * 16)(*T_world_camera), (ctypes.c_double * 2)(K[0], K[4]), (ctypes.c_double * 2)(K[2], K[5]),
    )  # fmt: skip


def raster_forward(source: RasterInput, images: RasterImages) -> Raster:
    """Renders into the planar `images`, alpha always. Raises ValueError for values that are not what they must be."""
    core = library()
    handle = ctypes.c_void_p()
    errors = core.core_raster_forward(ctypes.byref(source), ctypes.byref(images), ctypes.byref(handle))
    if errors:
        raise ValueError("; ".join(message for bit, message in _INPUT_ERRORS.items() if errors & bit))
    return Raster(core, handle)
