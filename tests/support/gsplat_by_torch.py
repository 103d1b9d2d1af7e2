"""gsplat without a GPU: its own Python, signatures and checks, and its own PyTorch in place of its CUDA kernels.

Projection, tiles, their order, the blending and what is accumulated are gsplat's (gsplat/cuda/_torch_impl.py). Two
things it has in CUDA alone, and they are ours: which Gaussians a pixel blends (discrete, no gradient), and the products
along a ray that it takes from nerfacc.
"""

from __future__ import annotations

import itertools
import sys
import types

import pytest
import torch
from torch import Tensor

from splatnode.recon import rasterize as dispatch
from splatnode.recon.rasterize import gsplat

_ALPHA_MIN, _ALPHA_MAX, _TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4  # of gsplat's kernels


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaussians on the processor are treated as if they were on a GPU, from the dispatch to gsplat's kernels."""
    wrapper = pytest.importorskip("gsplat.cuda._wrapper", reason="needs gsplat (the extra named cuda brings it)")
    monkeypatch.setattr(dispatch, "is_on_cpu", lambda tensor: False)
    check = gsplat.check_input
    monkeypatch.setattr(gsplat, "check_input", lambda *given: check(*given[:-1], "cpu"))
    monkeypatch.setattr(wrapper, "_FullyFusedProjection", types.SimpleNamespace(apply=_project))
    monkeypatch.setattr(wrapper, "_FullyFusedProjectionPacked", types.SimpleNamespace(apply=_project_packed))
    monkeypatch.setattr(wrapper, "_SphericalHarmonics", types.SimpleNamespace(apply=_harmonics))
    monkeypatch.setattr(wrapper, "_RasterizeToPixels", types.SimpleNamespace(apply=_rasterize))
    monkeypatch.setattr(wrapper, "_make_lazy_cuda_func", _KERNELS.__getitem__)
    rays = types.ModuleType("nerfacc")
    rays.render_weight_from_alpha = _weights_along_rays  # pyright: ignore[reportAttributeAccessIssue]
    rays.accumulate_along_rays = _accumulated_along_rays  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "nerfacc", rays)


def _implementation():
    from gsplat.cuda import _torch_impl  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

    return _torch_impl


def _project(
    means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near, far, clip, compensate, model, opacities
):
    assert clip == 0 and (covars is not None or quats is not None)
    if covars is None:
        full, _ = _implementation()._quat_scale_to_covar_preci(quats, scales, True, False)
    else:
        full = covars[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))
    project = _implementation()._fully_fused_projection
    radii, centres, depths, conics, compensations = project(
        means, full, viewmats, Ks, width, height, eps2d, near, far, compensate, model
    )
    seen = (opacities if compensations is None else opacities * compensations) >= _ALPHA_MIN
    drawn = (radii > 0).all(-1) & seen
    # The kernel leaves whatever was there where it draws nothing, but for compensations, and gives no gradient.
    centres, conics = (torch.where(drawn[..., None], each, torch.nan) for each in (centres, conics))
    compensations = None if compensations is None else torch.where(drawn, compensations, 0)
    return radii * drawn[..., None], centres, torch.where(drawn, depths, torch.nan), conics, compensations


def _project_packed(means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near, far, clip, sparse, *rest):
    assert not sparse
    given = (means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near, far, clip)
    radii, *projected = _project(*given, *rest)
    cameras, gaussians = (radii > 0).all(-1).nonzero(as_tuple=True)
    rows = [None if each is None else each[cameras, gaussians] for each in (radii, *projected)]
    return torch.zeros_like(cameras), cameras, gaussians, *rows


def _harmonics(degree, directions, coefficients, masks):
    """Where the mask is False the kernel leaves whatever was there, and gives no gradient."""
    found = _implementation()._spherical_harmonics(degree, directions[masks], coefficients[masks])
    return torch.full_like(directions, torch.nan).index_put((masks,), found)


def _rasterize(means2d, conics, colors, opacities, backgrounds, masks, width, height, tile, offsets, ids, absgrad):
    assert masks is None and not absgrad
    if means2d.dim() == 2:  # packed, of one camera
        means2d, conics, colors, opacities = means2d[None], conics[None], colors[None], opacities[None]
    if not len(ids):  # an image of nothing, which the kernels differentiate, too
        nothing = 0 * torch.stack([each.nan_to_num().sum() for each in (means2d, conics, colors, opacities)]).sum()
        return nothing.expand(1, height, width, colors.shape[-1]), nothing.expand(1, height, width, 1)
    rasterize = _implementation()._rasterize_to_pixels
    return rasterize(means2d, conics, colors, opacities, width, height, tile, offsets, ids, backgrounds)


def _tiles(means2d, radii, depths, images, gaussians, count, tile, width, height, sort, segmented):
    if means2d.dim() == 2:
        assert count == 1
        means2d, radii, depths = means2d[None], radii[None], depths[None]
    return _implementation()._isect_tiles(means2d, radii, depths, tile, width, height, sort)


def _offsets(isect_ids, images, width, height):
    return _implementation()._isect_offset_encode(isect_ids, images, width, height)


@torch.no_grad()
def _indices(start, end, light, means2d, conics, opacities, width, height, tile, offsets, ids):
    """Gaussian and pixel of every contribution, pixel by pixel from near to far, of one image."""
    assert start == 0 and len(means2d) == 1
    bounds = [*offsets.flatten().tolist(), len(ids)]
    found = []
    for index, (first, last) in enumerate(itertools.pairwise(bounds)):
        own = ids[first:last].long()
        row, column = divmod(index, offsets.shape[-1])
        v = torch.arange(row * tile, min((row + 1) * tile, height))
        u = torch.arange(column * tile, min((column + 1) * tile, width))
        v, u = (each.flatten() for each in torch.meshgrid(v, u, indexing="ij"))
        dx, dy = (u + 0.5)[:, None] - means2d[0, own, 0], (v + 0.5)[:, None] - means2d[0, own, 1]
        a, b, c = conics[0, own].unbind(-1)
        sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy
        alpha = (opacities[0, own] * torch.exp(-sigma)).clamp(max=_ALPHA_MAX)
        alpha = torch.where((sigma >= 0) & (alpha >= _ALPHA_MIN), alpha, 0)
        bright = light[0, v, u, None] * torch.cumprod(1 - alpha, 1) > _TRANSMITTANCE_MIN
        pixel, place = ((alpha > 0) & bright).nonzero(as_tuple=True)
        found.append(torch.stack([own[place], (v * width + u)[pixel]]))
    return torch.cat(found, 1).unbind(0)


def _weights_along_rays(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """The weight of each sample, and how much light reaches it; of a ray the nearest sample comes first."""
    counts = torch.bincount(ray_indices, minlength=n_rays)
    order = torch.argsort(ray_indices, stable=True)
    place = torch.arange(len(order)) - (torch.cumsum(counts, 0) - counts)[ray_indices[order]]
    dense = alphas.new_zeros(n_rays, int(counts.max()) + 1)
    passing = 1 - dense.index_put((ray_indices[order], place + 1), alphas[order])
    reaching = torch.cumprod(passing, 1)[ray_indices[order], place]
    light = torch.zeros_like(alphas).index_put((order,), reaching)
    return alphas * light, light


def _accumulated_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    """(n_rays, D) the sum of weight times value along each ray."""
    source = weights[:, None] if values is None else weights[:, None] * values
    return source.new_zeros(n_rays, source.shape[1]).index_add(0, ray_indices, source)


_KERNELS = {"intersect_tile": _tiles, "intersect_offset": _offsets, "rasterize_to_indices_3dgs": _indices}
