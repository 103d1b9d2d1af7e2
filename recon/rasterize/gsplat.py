"""The rasteriser on CUDA: gsplat (https://github.com/nerfstudio-project/gsplat, Apache-2.0) behind our interface.

A refinement on a GPU takes the time that its launches take, so there are few here, and nothing waits for the GPU but
gsplat itself, once an image. gsplat gives no gradient to the intrinsics. Where one is asked for, it is handed Gaussians
that are already in the camera frame, moved there by a map that is the identity in value and carries the gradients of
focal length and principal point.

Differences from the reference, in gsplat's kernels: alpha is cut off at 0.999 instead of 0.99; a pixel is finished
before its transmittance would fall to 1e-4, so that the last splat is missing (at most 1e-4 of its colour per unit of
transmittance that it lets through); Gaussians whose centre is more than 0.15 image widths (heights) outside the image
are drawn with the Jacobian at that distance; splats end at 3.33 standard deviations, where alpha is at most 0.004.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from splatnode.recon.geometry import matrices_from_quats
from splatnode.recon.rasterize.reference import ALPHA_MIN, CHANNELS, GUARD, LOW_PASS, NEAR, Render, check_input
from splatnode.recon.scene import SH_C0

_TILE = 16  # pixels, across and down: what gsplat was tested with
_SIZES = {"rgb": 3, "depth": 1, "normal": 3}  # of a Gaussian's features, in their order


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

    Raises ValueError where shapes, types or devices are wrong, or a camera that is on the processor is; other values
    are not checked.
    """
    check_input(means, quats, scales, opacities, sh, T_world_camera, K, width, height, channels, near, "cuda")
    if not len(means):
        return _render_blank(
            sum(tensor.sum() for tensor in (means, quats, scales, opacities, sh)), channels, width, height
        )
    T_world_camera, K = (tensor.to(means, non_blocking=True) for tensor in (T_world_camera, K))
    placed = means, None, quats, scales, _invert_motion(T_world_camera)
    if K.requires_grad:
        placed = _warp_gaussians(means, quats, scales, T_world_camera, K)
    splats = _project_gaussians(*placed, opacities, K.detach(), (width, height), antialias, near)
    features = []
    if "rgb" in channels:
        features.append(_compute_colours(sh, means, T_world_camera, splats.radii))
    if "depth" in channels:
        features.append(splats.depths[0, :, None])
    if "normal" in channels:
        features.append(_compute_normals(means, quats, scales, T_world_camera))
    if not features:
        features.append(torch.ones_like(means[:, :1]))
    blended = torch.cat(features, 1) if len(features) > 1 else features[0]
    return _split_channels(*_blend(splats, blended, width, height), channels)


def find_unavailable_reason() -> str | None:
    """Returns why gsplat cannot compute on a GPU here, as the end of a sentence; None where it can.

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


def _import_gsplat() -> Any:
    return import_module("gsplat")


def compute_intrinsics_warp(K: Tensor) -> Tensor:
    """(3, 3) map of the camera frame that is the identity in value, with the gradient of projecting with `K`.

    With the intrinsics held at their value, moving x by (fx' / fx) x + ((cx' - cx) / fx) z moves the projection as
    changing fx to fx' and cx to cx' would; z stays.
    """
    free = K.new_tensor([[1, 0, 1], [0, 1, 1], [0, 0, 0]])
    change = (K - K.detach()) * free / torch.diagonal(K.detach())[:, None]
    return torch.eye(3, dtype=K.dtype, device=K.device) + change


@dataclass(frozen=True, eq=False)
class _Splats:
    """The Gaussians as gsplat projected them. Where a radius is 0 nothing is drawn, and all else may be anything."""

    radii: Tensor  # (1, N, 2) int32, pixels
    centres: Tensor  # (1, N, 2) pixels
    depths: Tensor  # (1, N)
    conics: Tensor  # (1, N, 3) the inverse covariances' upper triangles
    opacities: Tensor  # (1, N)


def _warp_gaussians(
    means: Tensor, quats: Tensor, scales: Tensor, T_world_camera: Tensor, K: Tensor
) -> tuple[Tensor, Tensor, None, None, Tensor]:
    """The Gaussians in the camera frame, warped, as `_project_gaussians` takes them: some times as many launches."""
    R_world_camera, warp = T_world_camera[:3, :3], compute_intrinsics_warp(K)
    means_camera = (means - T_world_camera[:3, 3]) @ R_world_camera
    scaled_axes = warp @ R_world_camera.T @ (matrices_from_quats(quats) * scales[:, None])
    covariances = (scaled_axes @ scaled_axes.mT).flatten(1)[:, [0, 1, 2, 4, 5, 8]]
    identity = torch.eye(4, dtype=K.dtype, device=K.device)
    return means_camera @ warp.T, covariances, None, None, identity


def _project_gaussians(
    means: Tensor,  # (N, 3)
    covariances: Tensor | None,  # (N, 6) upper triangles; None: by what follows
    quats: Tensor | None,  # (N, 4)
    scales: Tensor | None,  # (N, 3)
    T_camera_world: Tensor,  # (4, 4)
    opacities: Tensor,  # (N,)
    K: Tensor,  # (3, 3)
    size: tuple[int, int],  # width, height
    antialias: bool,
    near: float,
) -> _Splats:
    """Projects the Gaussians by gsplat. Those outside the guard are not drawn."""
    radii, centres, depths, conics, compensations = _import_gsplat().fully_fused_projection(
        means, covariances, quats, scales, T_camera_world[None], K[None], *size,
        eps2d=LOW_PASS, near_plane=near, calc_compensations=antialias, opacities=opacities,
    )  # fmt: skip
    with torch.no_grad():
        radii = radii * (centres.clamp(*_guard(size, centres.dtype, centres.device)) == centres)
    shown = opacities[None]
    return _Splats(radii, centres, depths, conics, shown if compensations is None else shown * compensations)


@lru_cache(maxsize=64)
def _guard(size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """(2,) each: the least and the largest pixel at which a Gaussian's centre may be."""
    sides = torch.tensor(size, dtype=dtype, device=device)
    return -GUARD * sides, (1 + GUARD) * sides


def _invert_motion(T: Tensor) -> Tensor:
    """The inverse of a rigid motion (4, 4): the transposed rotation after the shift back, in three launches."""
    last, turn, one, shift = _make_motion_masks(T.dtype, T.device)
    return torch.addcmul(last, T.mT, turn) @ torch.addcmul(one, T, shift, value=-1)


@lru_cache(maxsize=8)
def _make_motion_masks(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(4, 4) each: the last diagonal element, where the rotation is, the identity, and where the shift is."""
    one = torch.eye(4)
    last, turn, shift = torch.zeros(3, 4, 4)
    last[3, 3], turn[:3, :3], shift[:3, 3] = 1, 1, 1
    last, turn, one, shift = (part.to(device, dtype) for part in (last, turn, one, shift))
    return last, turn, one, shift


def _blend(splats: _Splats, features: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The features (N, D) in each pixel (H, W, D), and what is seen of Gaussians there (H, W)."""
    gsplat = _import_gsplat()
    across, down = math.ceil(width / _TILE), math.ceil(height / _TILE)
    _, places, which = gsplat.isect_tiles(splats.centres, splats.radii, splats.depths, _TILE, across, down)
    offsets = gsplat.isect_offset_encode(places, 1, across, down)
    accumulated, alpha = gsplat.rasterize_to_pixels(
        splats.centres, splats.conics, features[None], splats.opacities, width, height, _TILE, offsets, which
    )
    return accumulated.squeeze(0), alpha.view(height, width)


def _compute_colours(sh: Tensor, means: Tensor, T_world_camera: Tensor, radii: Tensor) -> Tensor:
    """(N, 3) colours max(0, 0.5 + SH) as the camera sees them; anything where a radius is 0."""
    if sh.shape[1] == 1:
        colours = torch.add(torch.tensor(0.5, dtype=sh.dtype), sh.squeeze(1), alpha=SH_C0)
    else:
        degree, directions = math.isqrt(sh.shape[1]) - 1, means - T_world_camera[:3, 3]
        colours = 0.5 + _import_gsplat().spherical_harmonics(
            degree, directions, sh, masks=(radii > 0).all(-1).squeeze(0)
        )
    # As `clamp(min=0)`, whose gradient passes at 0, too, but this takes one launch for its gradient instead of three.
    return functional.threshold(colours, -1e-30, 0.0)


def _compute_normals(means: Tensor, quats: Tensor, scales: Tensor, T_world_camera: Tensor) -> Tensor:
    """(N, 3) the axes of least scale in the camera frame, turned to face the camera, as `reference.normals`."""
    thinnest = scales.detach().argmin(1)[:, None, None].expand(-1, 3, 1)
    axes = matrices_from_quats(quats).gather(2, thinnest).squeeze(2)
    with torch.no_grad():
        away = (axes * (means - T_world_camera[:3, 3])).sum(1, keepdim=True) > 0
        signs = torch.where(away, -1.0, 1.0)
    return (axes * signs) @ T_world_camera[:3, :3]


def _split_channels(accumulated: Tensor, alpha: Tensor, channels: Collection[str]) -> Render:
    names = [name for name in _SIZES if name in channels]
    parts = accumulated.split([_SIZES[name] for name in names], -1) if len(names) > 1 else [accumulated]
    found = dict(zip(names, parts, strict=False))
    depth = found.get("depth")
    if depth is not None:
        depth = depth.squeeze(-1) / alpha.clamp_min(ALPHA_MIN / 2)  # alpha is 0, where depth is, or at least ALPHA_MIN
    return Render(found.get("rgb"), depth, found.get("normal"), alpha if "alpha" in channels else None)


def _render_blank(anything: Tensor | int, channels: Collection[str], width: int, height: int) -> Render:
    """An image of nothing, whose gradients are zeros."""
    plane = (0 * torch.as_tensor(anything)).expand(height, width)
    coloured = plane[..., None].expand(height, width, 3)
    return Render(
        coloured if "rgb" in channels else None,
        plane if "depth" in channels else None,
        coloured if "normal" in channels else None,
        plane if "alpha" in channels else None,
    )
