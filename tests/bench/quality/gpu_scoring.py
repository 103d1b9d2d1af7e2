"""The rasteriser that finds held-out cameras, on a GPU: what it is given and what it gives are on the processor."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import lru_cache
from typing import Any

from torch import Tensor

from splatnode.recon.rasterize import gsplat
from splatnode.recon.rasterize.render import Render

_SCENE = 5  # tensors that are the Gaussians: the first arguments of a rasteriser; the camera follows


def rasterize_on_gpu(*given: Any, channels: Collection[str]) -> Render:
    """The colours as `gsplat.rasterize`, which takes the same, gives them. The Gaussians are moved there once."""
    render = gsplat.rasterize(*map(_on_gpu, given[:_SCENE]), *given[_SCENE:], channels=channels)
    return replace(render, rgb=None if render.rgb is None else render.rgb.cpu())


@lru_cache(maxsize=8)  # at least those of one scene
def _on_gpu(tensor: Tensor) -> Tensor:
    return tensor.cuda()
