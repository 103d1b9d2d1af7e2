"""The rasteriser on CUDA: gsplat (https://github.com/nerfstudio-project/gsplat, Apache-2.0) behind our interface.

gsplat gives no gradient to the intrinsics, and clamps the Jacobian of Gaussians beside the image by the camera's own
field of view. So it is handed Gaussians that are already in the camera frame, moved there by a map that is the
identity in value and carries the gradients of pose, focal length and principal point.

Differences from the reference, in gsplat's kernels: alpha is cut off at 0.999 instead of 0.99; a pixel is finished
before its transmittance would fall to 1e-4, so that the last splat is missing (at most 1e-4 of its colour per unit of
transmittance that it lets through); Gaussians whose centre is more than 0.15 image widths (heights) outside the image
are drawn with the Jacobian at that distance; splats end at 3.33 standard deviations, where alpha is at most 0.004.
"""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module

import torch
from torch import Tensor

from splatnode.recon.rasterize import reference
from splatnode.recon.rasterize.check import check_input
from splatnode.recon.rasterize.reference import CHANNELS, LOW_PASS, NEAR
from splatnode.recon.rasterize.render import Render


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
    """The image of the Gaussians, which are on a CUDA device, as the reference defines it but for what is said above.

    Raises ValueError where shapes, types or devices are wrong; values are not checked.
    """
    check_input(means, quats, scales, opacities, sh, T_world_camera, K, width, height, channels, near, "cuda")
    T_world_camera, K = T_world_camera.to(means), K.to(means)
    R_world_camera, centre = T_world_camera[:3, :3], T_world_camera[:3, 3]
    means_camera = (means - centre) @ R_world_camera
    seen = reference.nearest_first(means_camera, K, width, height, near)
    if not len(seen):
        return _blank(
            sum(tensor.sum() for tensor in (means_camera, quats, scales, opacities, sh, K)), channels, width, height
        )

    axes = R_world_camera.T @ reference.rotations(quats[seen])
    features = []
    if "rgb" in channels:
        features.append(reference.colours(sh[seen], means[seen] - centre))
    if "depth" in channels:
        features.append(means_camera[seen, 2:])
    if "normal" in channels:
        features.append(reference.normals(axes, scales[seen], means_camera[seen]))
    if not features:
        features.append(torch.ones_like(means_camera[seen, 2:]))
    warp = intrinsics_warp(K)
    scaled_axes = warp @ (axes * scales[seen, None])
    accumulated, alpha = _rasterization(
        means_camera[seen] @ warp.T,
        scaled_axes @ scaled_axes.mT,
        opacities[seen],
        torch.cat(features, 1),
        K.detach(),
        width,
        height,
        antialias,
        near,
    )
    return _split(accumulated, alpha, channels)


def obstacle() -> str | None:
    """What keeps gsplat from computing on a GPU here, as the end of a sentence; None where nothing does.

    The first time on a machine with a GPU this compiles gsplat's kernels, which takes minutes.
    """
    if not torch.cuda.is_available():
        return "torch finds none" if torch.version.cuda else "the torch that is installed is one without CUDA"
    try:
        kernels = import_module("gsplat.cuda._backend")._C
    except ImportError as error:
        return f"gsplat cannot be imported ({error}). Run: pip install 'splatnode[cuda]'"
    if kernels is None:
        return "gsplat found no CUDA toolkit (nvcc) to compile its kernels with"
    return None


def intrinsics_warp(K: Tensor) -> Tensor:
    """(3, 3) map of the camera frame that is the identity in value, with the gradient of projecting with `K`.

    With the intrinsics held at their value, moving x by (fx' / fx) x + ((cx' - cx) / fx) z moves the projection as
    changing fx to fx' and cx to cx' would; z stays.
    """
    free = K.new_tensor([[1, 0, 1], [0, 1, 1], [0, 0, 0]])
    change = (K - K.detach()) * free / torch.diagonal(K.detach())[:, None]
    return torch.eye(3, dtype=K.dtype, device=K.device) + change


def _rasterization(
    means_camera: Tensor,  # (M, 3)
    covariances: Tensor,  # (M, 3, 3) camera frame
    opacities: Tensor,  # (M,)
    features: Tensor,  # (M, D)
    K: Tensor,  # (3, 3)
    width: int,
    height: int,
    antialias: bool,
    near: float,
) -> tuple[Tensor, Tensor]:
    """The features (H, W, D) and their weights (H, W), blended by gsplat with the camera at the origin."""
    import gsplat

    unused = means_camera.new_zeros(len(means_camera), 4)  # quats and scales are not looked at beside covars
    accumulated, alpha, _ = gsplat.rasterization(  # pyright: ignore[reportAttributeAccessIssue]
        means_camera.contiguous(),
        unused,
        unused[:, :3],
        opacities,
        features,
        torch.eye(4, dtype=K.dtype, device=K.device)[None],
        K[None],
        width,
        height,
        near_plane=near,
        eps2d=LOW_PASS,
        packed=False,
        render_mode="RGB",
        rasterize_mode="antialiased" if antialias else "classic",
        covars=covariances,
    )
    return accumulated[0], alpha[0, ..., 0]


def _split(accumulated: Tensor, alpha: Tensor, channels: Collection[str]) -> Render:
    rgb = depth = normal = None
    place = 0
    if "rgb" in channels:
        rgb, place = accumulated[..., :3], 3
    if "depth" in channels:
        seen = alpha > 0
        depth = torch.where(seen, accumulated[..., place] / torch.where(seen, alpha, 1), 0)
        place += 1
    if "normal" in channels:
        normal = accumulated[..., place : place + 3]
    return Render(rgb, depth, normal, alpha if "alpha" in channels else None)


def _blank(anything: Tensor | int, channels: Collection[str], width: int, height: int) -> Render:
    """An image of nothing, whose gradients are zeros."""
    plane = (0 * torch.as_tensor(anything)).expand(height, width)
    coloured = plane[..., None].expand(height, width, 3)
    return Render(
        coloured if "rgb" in channels else None,
        plane if "depth" in channels else None,
        coloured if "normal" in channels else None,
        plane if "alpha" in channels else None,
    )
