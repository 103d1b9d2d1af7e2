"""What a camera sees of Gaussians."""

from __future__ import annotations

from collections.abc import Collection

from torch import Tensor

from splatnode.recon.rasterize.cpu import rasterize
from splatnode.recon.rasterize.render import Render
from splatnode.recon.scene.gaussians import Gaussians


def seen(
    gaussians: Gaussians,
    opacities: Tensor,  # (N,) in [0, 1], in place of the Gaussians' own
    T_world_camera: Tensor,  # (4, 4)
    K: Tensor,  # (3, 3)
    width: int,
    height: int,
    channels: Collection[str] = ("rgb",),
) -> Render:
    """The render by the core; see `recon.rasterize.cpu.rasterize`."""
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        opacities,
        gaussians.sh,
        T_world_camera,
        K,
        width,
        height,
        channels=channels,
    )
