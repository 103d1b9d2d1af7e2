"""Volume rendering: the colours and depths that a radiance field gives along rays."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from splatnode.recon.evaluate.rivals.nerf.field import Field

NEAR, FAR = 0.3, 20.0
SAMPLES = 32  # of a ray, evenly spaced in inverse depth
_OPAQUE = 30.0  # optical depth behind which nothing is seen; the numbers that would follow cost five times as much time


@dataclass(frozen=True, eq=False)
class RenderedRays:
    rgb: Tensor  # (M, 3)
    depth: Tensor  # (M,) expected z in the camera frame


def render_rays(
    field: Field,
    T_world_camera: Tensor,  # (4, 4)
    K: Tensor,  # (3, 3)
    pixels: Tensor,  # (M, 2) u, v
    jitter: torch.Generator | None = None,
) -> RenderedRays:
    """Colours and depths of pixels, differentiable in field, pose and K. `jitter` moves the samples at random."""
    rays = torch.cat([(pixels - K[:2, 2]) / torch.diagonal(K)[:2], torch.ones_like(pixels[:, :1])], 1)
    directions = rays @ T_world_camera[:3, :3].T
    steps = torch.arange(SAMPLES, dtype=pixels.dtype)
    shift = torch.rand(len(pixels), SAMPLES, generator=jitter) if jitter is not None else torch.tensor(0.5)
    share = (steps + shift).expand(len(pixels), SAMPLES) / SAMPLES
    z = 1.0 / (1.0 / NEAR + share * (1.0 / FAR - 1.0 / NEAR))  # (M, S), falling from near to far
    points = T_world_camera[:3, 3] + directions[:, None] * z[..., None]
    unit = functional.normalize(directions, dim=1)[:, None].expand_as(points)
    density, rgb = field(points.reshape(-1, 3), unit.reshape(-1, 3))
    weights = _compute_weights(density.view(z.shape), z * directions.norm(dim=1, keepdim=True))
    return RenderedRays((weights[..., None] * rgb.view(*z.shape, 3)).sum(1), (weights * z).sum(1))


def _compute_weights(density: Tensor, distance: Tensor) -> Tensor:
    """(M, S) what each sample adds to its ray, the last of them all that is left: nothing lies behind it."""
    optical = (density[:, :-1] * (distance[:, 1:] - distance[:, :-1])).clamp_max(_OPAQUE)
    opacity = torch.cat([1.0 - torch.exp(-optical), torch.ones_like(density[:, :1])], 1)
    before = torch.cumsum(optical, 1)
    return opacity * torch.cat([torch.ones_like(before[:, :1]), torch.exp(-before.clamp_max(_OPAQUE))], 1)
