"""Renders of Gaussians with NumPy alone: previews and the viewer run without torch. There are no gradients."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.core import set_threads
from splatnode.recon.rasterize.native import RasterImages, make_raster_input, raster_forward
from splatnode.recon.result.snapshot import GaussianArrays

Array = npt.NDArray[np.float32]
NEAR = 0.01  # world units; splatnode.recon.rasterize.reference has it too, but needs torch


@dataclass(frozen=True, eq=False)
class RenderedArrays:
    """The channels of `recon.rasterize.render.Render`; one that was not asked for is empty, (0, 0) or (0, 0, 3)."""

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
