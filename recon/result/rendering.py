"""Renders of Gaussians with NumPy alone: previews and the viewer run without torch. There are no gradients.

The C interface of the compiled rasteriser is here, too: it serves NumPy and torch alike.
"""

from __future__ import annotations

import ctypes
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, set_threads
from splatnode.recon.result.snapshot import GaussianArrays

# The C interface of the compiled rasteriser (recon/core/rasterize.h), for NumPy and torch alike: it needs neither.

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


# Renders of Gaussians with NumPy alone: previews and the viewer run without torch. There are no gradients.

Array = npt.NDArray[np.float32]
NEAR = 0.01  # world units; splatnode.recon.rasterize.reference has it too, but needs torch


@dataclass(frozen=True, eq=False)
class RenderedArrays:
    """The channels of `recon.rasterize.reference.Render`; one that was not asked for is empty, (0, 0) or (0, 0, 3)."""

    rgb: Array  # (H, W, 3) on black, not clipped
    depth: Array  # (H, W) expected z in the camera frame, 0 where alpha is 0
    normal: Array  # (H, W, 3) in the camera frame, facing the camera, weighted by alpha
    alpha: Array  # (H, W)


def use_threads(threads: int) -> None:
    """Bounds the processors that a render takes. Raises ValueError below 1."""
    set_threads(threads)


def render_arrays(
    gaussians: GaussianArrays,
    T_world_camera: npt.NDArray[np.float64],  # (4, 4) rigid
    K: npt.NDArray[np.float64],  # (3, 3)
    width: int,
    height: int,
    *,
    channels: Collection[str] = ("rgb",),
) -> RenderedArrays:
    """The Gaussians rendered by the compiled core, as `recon.rasterize.reference.rasterize` defines it.

    Raises ValueError where shapes or values are not what they must be.
    """
    arrays = [
        np.ascontiguousarray(array, np.float32)
        for array in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    ]
    count, bases = len(gaussians), gaussians.sh.shape[1]
    shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, bases, 3)]
    if [array.shape for array in arrays] != shapes or bases not in (1, 4, 9, 16):
        raise ValueError(f"Gaussians must have the shapes {shapes}, got {[array.shape for array in arrays]}")
    if T_world_camera.shape != (4, 4) or K.shape != (3, 3) or width < 1 or height < 1:
        raise ValueError(
            f"a camera must be (4, 4), (3, 3) and a size of at least 1 x 1, got {T_world_camera.shape}, {K.shape}, "
            f"{width} x {height}"
        )
    unknown = set(channels) - {"rgb", "depth", "normal", "alpha"}
    if unknown:
        raise ValueError(f"channels must be of rgb, depth, normal and alpha; got {sorted(unknown)}")

    source = make_raster_input(
        count,
        bases,
        [array.ctypes.data for array in arrays],
        T_world_camera.astype(np.float64).ravel().tolist(),
        K.astype(np.float64).ravel().tolist(),
        width,
        height,
        channels,
        False,
        NEAR,
    )
    planes = {"rgb": 3, "depth": 1, "normal": 3, "alpha": 1}
    wanted = {*channels, "alpha"}  # the core always writes alpha
    images = {
        name: np.empty((number, height, width) if name in wanted else (number, 0, 0), np.float32)
        for name, number in planes.items()
    }
    addresses = {name: image.ctypes.data if image.size else None for name, image in images.items()}
    raster_forward(source, RasterImages(**addresses))
    return RenderedArrays(
        rgb=images["rgb"].transpose(1, 2, 0),
        depth=images["depth"][0],
        normal=images["normal"].transpose(1, 2, 0),
        alpha=images["alpha"][0],
    )
