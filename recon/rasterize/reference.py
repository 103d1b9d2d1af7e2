"""The definition of the rasteriser: readable PyTorch, dense over pixels, in the dtype of its inputs.

Every other back-end equals this one in values and gradients, or states and bounds the difference. It takes
O(N H W) memory: use it for small scenes and for tests, in float64 where it matters.

Sources: "3D Gaussian Splatting" (Kerbl et al. 2023), equations 4-6 and appendix A; the affine approximation is "EWA
Splatting" (Zwicker et al. 2002); the compensation of the low-pass is that of "Mip-Splatting" (Yu et al. 2024).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import torch
from torch import Tensor

from splatnode.recon.rasterize.render import Render
from splatnode.recon.result.spherical_harmonics import compute_sh_terms

CHANNELS = ("rgb", "depth", "normal", "alpha")
LOW_PASS = 0.3  # px^2, added to the variance of every splat: none is thinner than a pixel
ALPHA_MIN = 1 / 255  # a splat contributes to a pixel where its alpha is at least this
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4  # a pixel takes no more splats once less light than this comes through
GUARD = 0.3  # centres further outside the image than this part of its width or height are skipped
NEAR = 0.01  # world units


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
    """The image of the Gaussians, differentiable in all tensors (of K: the focal lengths and the principal point).

    Skipped are Gaussians with z < `near` in the camera frame and those whose centre projects further than `GUARD`
    outside the image, where the affine approximation of the projection breaks down. Scenes without metric scale have
    no natural `near`: pass a small part of the scene's depth if the default does not fit.
    With `antialias` the opacity is lowered by what the low-pass filter added to the splat's area.
    """
    splats = project(means, quats, scales, opacities, sh, T_world_camera, K, width, height, antialias, near)
    weights = compute_blend_weights(splats, width, height)  # (H W, N)
    alpha = weights.sum(1)
    image = (height, width)
    rgb = depth = normal = None
    if "rgb" in channels:
        rgb = (weights @ splats.colours).view(*image, 3)
    if "depth" in channels:
        seen = alpha > 0
        depth = torch.where(seen, weights @ splats.depths / torch.where(seen, alpha, 1), 0).view(image)
    if "normal" in channels:
        normal = (weights @ splats.normals).view(*image, 3)
    return Render(rgb, depth, normal, alpha.view(image) if "alpha" in channels else None)


@dataclass(frozen=True, eq=False)
class Splats:
    """M Gaussians as the camera sees them, nearest first (of equal ones the first given comes first)."""

    centres: Tensor  # (M, 2) pixels
    covariances: Tensor  # (M, 2, 2) pixels^2, low-pass included
    opacities: Tensor  # (M,)
    colours: Tensor  # (M, 3)
    depths: Tensor  # (M,) z in the camera frame
    normals: Tensor  # (M, 3) unit, camera frame, facing the camera


def project(
    means: Tensor,  # (N, 3)
    quats: Tensor,  # (N, 4)
    scales: Tensor,  # (N, 3)
    opacities: Tensor,  # (N,)
    sh: Tensor,  # (N, B, 3)
    T_world_camera: Tensor,  # (4, 4)
    K: Tensor,  # (3, 3)
    width: int,
    height: int,
    antialias: bool = False,
    near: float = NEAR,
) -> Splats:
    """The splats of the Gaussians that are in front of the camera and inside the guarded frustum."""
    R_world_camera, centre = T_world_camera[:3, :3], T_world_camera[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means_camera = (means - centre) @ R_world_camera
    seen = sort_visible(means_camera, K, width, height, near)
    x, y, z = means_camera[seen].unbind(1)
    axes = R_world_camera.T @ compute_rotations(quats[seen])  # (M, 3, 3), columns in the camera frame
    zero = torch.zeros_like(z)
    jacobians = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], 1).view(-1, 2, 3)
    scaled = jacobians @ axes * scales[seen, None]  # (M, 2, 3)
    low_pass = LOW_PASS * torch.eye(2, dtype=means.dtype, device=means.device)
    covariances = scaled @ scaled.mT + low_pass
    visible_opacities = opacities[seen]
    if antialias:
        # The determinant of scaled @ scaled.mT is this cross product's squared length, without cancellation.
        area = torch.linalg.cross(scaled[:, 0], scaled[:, 1]).norm(dim=1)
        visible_opacities = visible_opacities * area / torch.linalg.det(covariances).sqrt()
    return Splats(
        centres=torch.stack([fx * x / z + cx, fy * y / z + cy], 1),
        covariances=covariances,
        opacities=visible_opacities,
        colours=compute_colours(sh[seen], means[seen] - centre),
        depths=z,
        normals=compute_normals(axes, scales[seen], means_camera[seen]),
    )


@torch.no_grad()
def sort_visible(means_camera: Tensor, K: Tensor, width: int, height: int, near: float) -> Tensor:
    """(M,) which of the means (N, 3) in the camera frame are drawn: in front and inside the guard, sorted by depth."""
    x, y, z = means_camera.unbind(1)
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    inside = (u >= -GUARD * width) & (u <= (1 + GUARD) * width) & (v >= -GUARD * height) & (v <= (1 + GUARD) * height)
    seen = torch.nonzero((z >= near) & inside).squeeze(1)
    return seen[torch.argsort(z[seen], stable=True)]


def compute_blend_weights(splats: Splats, width: int, height: int) -> Tensor:
    """(H W, M) the part of every splat in every pixel: its alpha times what the nearer ones let through."""
    dtype, device = splats.centres.dtype, splats.centres.device
    rows = torch.arange(height, dtype=dtype, device=device) + 0.5
    columns = torch.arange(width, dtype=dtype, device=device) + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    offsets = torch.stack([u.flatten(), v.flatten()], 1)[:, None] - splats.centres  # (H W, M, 2)
    mahalanobis = torch.einsum("pmi,mij,pmj->pm", offsets, torch.linalg.inv(splats.covariances), offsets)
    alphas = splats.opacities * torch.exp(-0.5 * mahalanobis)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas.clamp(max=ALPHA_MAX), 0)
    after = torch.cumprod(1 - alphas, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    return torch.where(before >= TRANSMITTANCE_MIN, alphas * before, 0)


def compute_rotations(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotation matrices of quaternions (N, 4) wxyz of any length."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        1,
    ).view(-1, 3, 3)  # fmt: skip


def compute_colours(sh: Tensor, directions: Tensor) -> Tensor:
    """(N, 3) colours max(0, 0.5 + SH) of coefficients (N, B, 3) seen along `directions` (N, 3) of any length."""
    basis = compute_sh_basis(directions / directions.norm(dim=1, keepdim=True), sh.shape[1])
    return (0.5 + torch.einsum("nb,nbc->nc", basis, sh)).clamp(min=0)


def compute_sh_basis(directions: Tensor, bases: int) -> Tensor:
    """(N, B) real spherical harmonics of unit vectors (N, 3), in the order and with the signs of 3DGS."""
    x, y, z = directions.unbind(1)
    return torch.stack(compute_sh_terms(x, y, z, bases), 1)


def compute_normals(axes: Tensor, scales: Tensor, means_camera: Tensor) -> Tensor:
    """(N, 3) the axis of least scale (of equal ones the first), turned to face the camera."""
    first, second, third = scales.unbind(1)
    thinnest = torch.where((first <= second) & (first <= third), 0, torch.where(second <= third, 1, 2))
    axis = axes.gather(2, thinnest[:, None, None].expand(-1, 3, 1)).squeeze(2)
    away = (axis * means_camera).sum(1, keepdim=True) > 0
    return torch.where(away, -axis, axis)
