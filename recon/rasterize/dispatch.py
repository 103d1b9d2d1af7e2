"""Who computes with Gaussians: the core where their tensors are on the processor, elsewhere gsplat and torch."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from splatnode.recon.rasterize import cpu, gsplat
from splatnode.recon.rasterize.reference import Render
from splatnode.recon.scene.scene import Gaussians


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


# Renders of a scene's Gaussians, as the optimiser and its tests ask for them.


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion."""

    T_world_camera: Tensor  # (4, 4)
    K: Tensor  # (3, 3), pixels; the centre of the top-left pixel is at (0.5, 0.5)
    width: int  # pixels
    height: int


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    channels: Collection[str] = ("rgb",),  # fields of Render
    *,
    opacities: Tensor | None = None,  # (N,) in [0, 1], in place of the Gaussians' own
) -> Render:
    """The Gaussians as `camera` sees them, with gradients, on their own device; see `recon.rasterize.dispatch`."""
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities if opacities is None else opacities,
        gaussians.sh,
        camera.T_world_camera,
        camera.K,
        camera.width,
        camera.height,
        channels=channels,
    )


# The device that a scene is refined on: what the configuration asks for, held against what there is.

Device = Literal["cpu", "cuda", "auto"]  # auto: cuda where it can be used, else cpu


class DeviceUnavailable(RuntimeError):
    """The device that was asked for cannot be used here."""

    exit_code = 69


def choose_device(wanted: Device) -> torch.device:
    """The device to compute on. Raises DeviceUnavailable for a GPU that cannot be used, with the reason."""
    if wanted == "cpu":
        return torch.device("cpu")
    obstacle = gsplat.find_unavailable_reason()
    if obstacle is None:
        return torch.device("cuda")
    if wanted == "cuda":
        raise DeviceUnavailable(
            f"device cuda needs an NVIDIA GPU that torch and gsplat can use, but {obstacle}. "
            "Take device auto or cpu to go on without it; `splatnode doctor` tells what there is"
        )
    return torch.device("cpu")


def format_device(wanted: Device, device: torch.device) -> str:
    """One line about `chosen(wanted)`, for the log."""
    if device.type == "cuda":
        return f"scenes are refined on {torch.cuda.get_device_name(device)}, by gsplat"
    return "scenes are refined on the processor" + (f": {gsplat.find_unavailable_reason()}" if wanted == "auto" else "")
