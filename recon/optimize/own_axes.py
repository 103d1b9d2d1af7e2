"""Steps of positions along each Gaussian's own axes, in its standard deviations.

A Gaussian shows a shift along its thin axis far sooner than one along its long axis. Its covariance is the metric in
which both count alike, so that this is the natural gradient of a Gaussian's mean (Amari, "Natural gradient works
efficiently in learning", 1998) under Adam. A step is a share of the Gaussian's extent, in whatever unit the scene is.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from splatnode.recon.core import library
from splatnode.recon.geometry import matrices_from_quats
from splatnode.recon.optimize.adam import Adam
from splatnode.recon.rasterize import dispatch
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
        offsets, turned = self._adam.params["offsets"], make_axis_rotation(gaussians)
        offsets.grad = turned(gaussians.means.grad, to_world=False)
        self._adam.lrs = {"offsets": rate}
        self._adam.step()
        gaussians.means.add_(turned(offsets, to_world=True))
        offsets.zero_()

    def follow(self, gaussians: Gaussians, origin: Tensor) -> None:
        """Goes on with these Gaussians; `origin` (N,) is as in `Adam.follow`."""
        self._adam.follow({"offsets": _zeros(gaussians)}, origin)


def rotate_to_axes(gradients: Tensor, gaussians: Gaussians) -> Tensor:
    """(N, 3) the derivatives by offsets along the axes, of derivatives by positions `gradients` (N, 3)."""
    return make_axis_rotation(gaussians)(gradients, to_world=False)


def rotate_to_world(offsets: Tensor, gaussians: Gaussians) -> Tensor:
    """(N, 3) the shifts in the world, of `offsets` (N, 3) along the axes in standard deviations."""
    return make_axis_rotation(gaussians)(offsets, to_world=True)


def make_axis_rotation(gaussians: Gaussians) -> Callable[..., Tensor]:
    """A function of vectors (N, 3) and of `to_world`, by which vectors along the axes of `gaussians` turn into it."""
    quats, log_scales = gaussians.quats.detach(), gaussians.log_scales.detach()
    if dispatch.is_on_cpu(quats):
        return partial(_rotate_by_core, quats, log_scales)
    return partial(rotate_by_torch, axes_by_torch(quats, log_scales))


def _rotate_by_core(quats: Tensor, log_scales: Tensor, vectors: Tensor, to_world: bool) -> Tensor:
    given = [tensor.to(torch.float32).contiguous() for tensor in (quats, log_scales, vectors.detach())]
    result = torch.empty_like(given[2])
    addresses = [ctypes.c_void_p(tensor.data_ptr()) for tensor in given]
    largest, count = ctypes.c_double(LARGEST_EXTENT), ctypes.c_int64(len(result))
    library().core_own_axes(*addresses, count, largest, int(to_world), ctypes.c_void_p(result.data_ptr()))
    return result.to(vectors.dtype)


def axes_by_torch(quats: Tensor, log_scales: Tensor) -> Tensor:
    """(N, 3, 3) the axes in columns, as long as their standard deviations count."""
    return matrices_from_quats(quats) * log_scales.exp().clamp_max(LARGEST_EXTENT)[:, None, :]


def rotate_by_torch(axes: Tensor, vectors: Tensor, to_world: bool) -> Tensor:
    """Rotates as the core does, on any device."""
    beside = vectors[:, None, :] if to_world else vectors[:, :, None]
    return (axes * beside).sum(2 if to_world else 1)


def _zeros(gaussians: Gaussians) -> Tensor:
    return torch.zeros_like(gaussians.means, requires_grad=True)
