"""The definition of the rasteriser: readable PyTorch, dense over pixels, in the dtype of its inputs.

Every other back-end equals this one in values and gradients, or states and bounds the difference. It takes
O(N H W) memory: use it for small scenes and for tests, in float64 where it matters.

Sources: "3D Gaussian Splatting" (Kerbl et al. 2023), equations 4-6 and appendix A; the affine approximation is "EWA
Splatting" (Zwicker et al. 2002); the compensation of the low-pass is that of "Mip-Splatting" (Yu et al. 2024).
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import torch
from torch import Tensor

from splatnode.recon.result.placement import compute_sh_terms

# Render: what every rasteriser returns.


@dataclass(frozen=True, eq=False)
class Render:
    """An image of the Gaussians. A channel that was not asked for is None."""

    rgb: Tensor | None  # (H, W, 3) on black: sum of w_k c_k (equation 2)
    depth: Tensor | None  # (H, W) expected z in the camera frame: sum of w_k z_k / sum of w_k, 0 where alpha is 0
    normal: Tensor | None  # (H, W, 3) sum of w_k n_k in the camera frame, facing the camera (equation 4)
    alpha: Tensor | None  # (H, W) sum of w_k

    def move_to_device(self, device: torch.device) -> Render:
        """The same image on `device`; gradients find their way back."""
        channels = (self.rgb, self.depth, self.normal, self.alpha)
        return Render(*(None if channel is None else channel.to(device) for channel in channels))


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


# What every rasteriser asks of its input.

SH_BASES = (1, 4, 9, 16)
MAX_SIDE = 16384  # pixels


def check_input(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    T_world_camera: Tensor,
    K: Tensor,
    width: int,
    height: int,
    channels: Collection[str],
    near: float,
    device_type: str,
) -> None:
    """Raises ValueError for the first shape, dtype, device or number that a rasteriser cannot take.

    Values of the Gaussians are not looked at: that takes time, and back-ends do it on the way. Nor are those of a
    camera that is not on the processor, which would have to wait for them.
    """
    gaussians = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    for name, tensor in {**gaussians, "T_world_camera": T_world_camera, "K": K}.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise ValueError(f"{name} must be a tensor of floats, got {kind}")
    for name, tensor in gaussians.items():
        if tensor.device.type != device_type:
            raise ValueError(f"{name} must be on {device_type} for this rasteriser, got {tensor.device}")
    count = means.shape[0] if means.dim() else 0
    for name, tensor, shape in (
        ("means", means, (count, 3)),
        ("quats", quats, (count, 4)),
        ("scales", scales, (count, 3)),
        ("opacities", opacities, (count,)),
        ("T_world_camera", T_world_camera, (4, 4)),
        ("K", K, (3, 3)),
    ):
        if tuple(tensor.shape) != shape:
            wanted = f"(N, {shape[-1]})" if name in ("means", "quats", "scales") else shape
            hint = f" (N = {count} from means)" if name != "means" and name in gaussians else ""
            raise ValueError(f"{name} must be {wanted}{hint}, got {tuple(tensor.shape)}")
    if sh.dim() != 3 or sh.shape[0] != count or sh.shape[1] not in SH_BASES or sh.shape[2] != 3:
        raise ValueError(f"sh must be ({count}, B, 3) with B in {SH_BASES}, got {tuple(sh.shape)}")
    for name, side in (("width", width), ("height", height)):
        if not isinstance(side, int) or not 1 <= side <= MAX_SIDE:
            raise ValueError(f"{name} must be an integer from 1 to {MAX_SIDE}, got {side!r}")
    unknown = set(channels) - set(CHANNELS)
    if unknown or not channels or isinstance(channels, str):
        raise ValueError(f"channels must be some of {CHANNELS}, got {channels!r}")
    if not 0 < near < float("inf"):
        raise ValueError(f"near must be positive, got {near}")
    if T_world_camera.device.type == "cpu":
        _check_pose(T_world_camera.detach())
    if K.device.type == "cpu":
        _check_intrinsics(K.detach())


def _check_pose(T_world_camera: Tensor) -> None:
    T = T_world_camera.tolist()
    if not all(math.isfinite(value) for row in T for value in row):
        raise ValueError(f"T_world_camera must be finite, got {T}")
    drift = max(
        abs(sum(T[i][k] * T[j][k] for k in range(3)) - (1.0 if i == j else 0.0)) for i in range(3) for j in range(i + 1)
    )
    if drift > 1e-2 or max(abs(value - last) for value, last in zip(T[3], (0, 0, 0, 1), strict=True)) > 1e-6:
        raise ValueError(f"T_world_camera must be a rigid transform (its rotation is off by {drift:.2g}), got {T}")


def _check_intrinsics(K: Tensor) -> None:
    matrix = K.tolist()
    if not all(math.isfinite(value) for row in matrix for value in row) or matrix[0][0] <= 0 or matrix[1][1] <= 0:
        raise ValueError(f"K must be finite with positive focal lengths, got {matrix}")
    if matrix[0][1] != 0 or matrix[1][0] != 0 or matrix[2] != [0, 0, 1]:
        raise ValueError(f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {matrix}")
