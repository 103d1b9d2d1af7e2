"""Renders of a scene's Gaussians, as the optimiser and its tests ask for them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from torch import Tensor

from splatnode.recon.rasterize.dispatch import rasterize
from splatnode.recon.rasterize.render import Render
from splatnode.recon.scene.gaussians import Gaussians


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
    """The Gaussians as `camera` sees them, with gradients, on their own device; see `recon.rasterize.dispatch`."""
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
