"""Steps of positions along each Gaussian's own axes, in its standard deviations.

A Gaussian shows a shift along its thin axis far sooner than one along its long axis. Its covariance is the metric in
which both count alike, so that this is the natural gradient of a Gaussian's mean (Amari, "Natural gradient works
efficiently in learning", 1998) under Adam. A step is a share of the Gaussian's extent, in whatever unit the scene is.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from splatnode.recon.core import library
from splatnode.recon.optimize.adam import Adam
from splatnode.recon.rasterize import dispatch
from splatnode.recon.rasterize.reference import rotations
from splatnode.recon.scene.gaussians import Gaussians

LARGEST_EXTENT = 0.2  # standard deviation that counts at most, in median depths: the far shell's are many times that


class Shifts:
    """Adam of the offsets (N, 3) by which each mean has moved along its Gaussian's axes; it starts at 0 each step."""

    def __init__(self, gaussians: Gaussians) -> None:
        self._adam = Adam({"offsets": _zeros(gaussians)}, {"offsets": 0.0})

    @torch.no_grad()
    def step(self, gaussians: Gaussians, rate: float) -> None:
        """Moves `gaussians.means`, which must have their gradient, by about `rate` standard deviations."""
        assert gaussians.means.grad is not None
        offsets = self._adam.params["offsets"]
        offsets.grad = along_axes(gaussians.means.grad, gaussians)
        self._adam.lrs = {"offsets": rate}
        self._adam.step()
        gaussians.means.add_(in_world(offsets, gaussians))
        offsets.zero_()

    def follow(self, gaussians: Gaussians, origin: Tensor) -> None:
        """Goes on with these Gaussians; `origin` (N,) is as in `Adam.follow`."""
        self._adam.follow({"offsets": _zeros(gaussians)}, origin)


def along_axes(gradients: Tensor, gaussians: Gaussians) -> Tensor:
    """(N, 3) the derivatives by offsets along the axes, of derivatives by positions `gradients` (N, 3)."""
    return _turned(gradients, gaussians, to_world=False)


def in_world(offsets: Tensor, gaussians: Gaussians) -> Tensor:
    """(N, 3) the shifts in the world, of `offsets` (N, 3) along the axes in standard deviations."""
    return _turned(offsets, gaussians, to_world=True)


def _turned(vectors: Tensor, gaussians: Gaussians, to_world: bool) -> Tensor:
    quats, log_scales = gaussians.quats.detach(), gaussians.log_scales.detach()
    if not dispatch.by_core(vectors):
        return turned_by_torch(vectors, quats, log_scales, to_world)
    given = [tensor.to(torch.float32).contiguous() for tensor in (quats, log_scales, vectors.detach())]
    result = torch.empty_like(given[2])
    addresses = [ctypes.c_void_p(tensor.data_ptr()) for tensor in given]
    largest, count = ctypes.c_double(LARGEST_EXTENT), ctypes.c_int64(len(result))
    library().core_own_axes(*addresses, count, largest, int(to_world), ctypes.c_void_p(result.data_ptr()))
    return result.to(vectors.dtype)


def turned_by_torch(vectors: Tensor, quats: Tensor, log_scales: Tensor, to_world: bool) -> Tensor:
    """What the core does, on any device."""
    axes = rotations(quats) * log_scales.exp().clamp_max(LARGEST_EXTENT)[:, None, :]  # (N, 3, 3), in columns
    return torch.einsum("nij,nj->ni" if to_world else "nji,nj->ni", axes, vectors)


def _zeros(gaussians: Gaussians) -> Tensor:
    return torch.zeros_like(gaussians.means, requires_grad=True)
