"""The device that a scene is refined on: what the configuration asks for, held against what there is."""

from __future__ import annotations

from typing import Literal

import torch

from splatnode.recon.rasterize import gsplat

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
