"""Who computes with Gaussians: the core where their tensors are on the processor, elsewhere gsplat and torch."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from splatnode.recon.rasterize import cpu, gsplat
from splatnode.recon.rasterize.render import Render


def is_on_cpu(tensor: Tensor) -> bool:
    """Whether the compiled core computes with this tensor."""
    return tensor.device.type == "cpu"


def rasterize(means: Tensor, *further: Any, **options: Any) -> Render:
    """The image of the Gaussians on the device of `means`; arguments and result are those of `cpu.rasterize`.

    `gsplat.rasterize` says where the two differ. The camera may be on another device than the Gaussians are.
    """
    return (cpu.rasterize if is_on_cpu(means) else gsplat.rasterize)(means, *further, **options)


def make_rasterizer(device: torch.device) -> Callable[..., Render]:
    """A `rasterize` that computes on `device` and takes and gives tensors on the processor. It can be pickled."""
    return rasterize if device.type == "cpu" else partial(_rasterize_on, device)


def _rasterize_on(device: torch.device, means: Tensor, *further: Any, **options: Any) -> Render:
    tensors = (each.to(device) if isinstance(each, Tensor) else each for each in further)
    return rasterize(means.to(device), *tensors, **options).move_to_device(torch.device("cpu"))
