"""The rasteriser that finds held-out cameras, on a GPU: what it is given and what it gives are on the processor."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import lru_cache

from torch import Tensor

from splatnode.recon.rasterize import gsplat
from splatnode.recon.rasterize.render import Render


def rasterize_on_gpu(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    T_world_camera: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    channels: Collection[str],
) -> Render:
    """The colours as `gsplat.rasterize` gives them. The scene, of which nothing is asked but images, is moved once."""
    scene = [_on_gpu(tensor) for tensor in (means, quats, scales, opacities, sh)]
    render = gsplat.rasterize(*scene, T_world_camera, K, width, height, channels=channels)
    return replace(render, rgb=None if render.rgb is None else render.rgb.cpu())


@lru_cache(maxsize=8)  # of one scene there are five
def _on_gpu(tensor: Tensor) -> Tensor:
    return tensor.cuda()
