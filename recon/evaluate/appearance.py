"""What a benchmark asks of a scene: how it looks from a camera. Gaussians are one answer, a radiance field another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.rasterize.render import Render
from splatnode.recon.result.export import sanitize_gaussians
from splatnode.recon.result.export.formats.ply import compute_ply_bytes
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot

Array = npt.NDArray[np.float64]
Rasterize = Callable[..., Render]


class Appearance(Protocol):
    """A finished scene as a function from cameras to images."""

    @property
    def num_gaussians(self) -> int | None:
        """None for a scene that is not made of them."""
        ...

    @property
    def num_bytes(self) -> int:
        """Returns the size of the scene as it would be published."""
        ...

    def depth(self, T_world_camera: Array) -> float:
        """The median depth of what a camera has before it."""
        ...

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        """Mean absolute difference to `image` (H, W, 3), scalar, differentiable with respect to the pose (4, 4).

        Where `used` (H, W) says so, which it does somewhere; None: everywhere.
        """
        ...

    def render(self, T_world_camera: Array, K: Array, width: int, height: int) -> Tensor:
        """(H, W, 3) the image; above 1 where it is brighter than white."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldSnapshot(Snapshot):
    """The snapshot of a method without Gaussians; `appearance` is pickled from process to process."""

    appearance: Appearance


def make_appearance(snapshot: Snapshot, rasterize: Rasterize) -> Appearance | None:
    """How a snapshot's scene looks; None where its verdict forbids publishing it, or it has none."""
    if not snapshot.verdict.publishable:
        return None
    if isinstance(snapshot, FieldSnapshot):
        return snapshot.appearance
    gaussians = sanitize_gaussians(snapshot.gaussians)
    return GaussianAppearance(gaussians, rasterize) if len(gaussians) else None


class GaussianAppearance:
    """Gaussians on black."""

    def __init__(self, gaussians: GaussianArrays, rasterize: Rasterize) -> None:
        self._gaussians, self._rasterize = gaussians, rasterize
        arrays = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh
        self._tensors = [torch.from_numpy(array) for array in arrays]

    @property
    def num_gaussians(self) -> int:
        return len(self._gaussians)

    @property
    def num_bytes(self) -> int:
        return compute_ply_bytes(len(self._gaussians), self._gaussians.sh.shape[1])

    def depth(self, T_world_camera: Array) -> float:
        """The median depth of the Gaussians in front of the camera; 1 where there are none."""
        z = (self._gaussians.means - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
        ahead = z[z > 0]
        return float(np.median(ahead)) if len(ahead) else 1.0

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        height, width = image.shape[:2]
        rgb = self._rasterize(*self._tensors, T_world_camera, K, width, height, channels=("rgb",)).rgb
        if rgb is None:
            raise ValueError("the rasteriser was asked for the channel rgb and gave none")
        off = (rgb - image).abs()
        return (off if used is None else off[used]).mean()

    def render(self, T_world_camera: Array, K: Array, width: int, height: int) -> Tensor:
        return torch.from_numpy(render_arrays(self._gaussians, T_world_camera, K, width, height).rgb)
