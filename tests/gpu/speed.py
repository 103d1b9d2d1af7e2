"""Milliseconds of an iteration on a device, for the scenes that `python -m tests.bench rasterize` times on the core."""

from __future__ import annotations

import time

import torch

from splatnode.recon.optimize.adam import Adam
from splatnode.recon.optimize.photometric_loss import PhotometricLoss
from splatnode.recon.rasterize import dispatch
from tests.bench.speed.rasterize import CASES, LRS, Case, bumpy_surface

ROUNDS, UNTIMED = 30, 5


def milliseconds(device: torch.device) -> dict[str, float]:
    """The median of an iteration (image, loss, gradients, Adam), by case."""
    return {f"{case.name}, ms an iteration": _iteration_ms(case, device) for case in CASES}


def _iteration_ms(case: Case, device: torch.device) -> float:
    scene = bumpy_surface(case)
    params = {
        name: param.detach().to(device).requires_grad_() for name, param in scene.params.items() if name != "twist"
    }
    adam = Adam(params, {name: scene.lr_factor * LRS[name] for name in params})
    loss = PhotometricLoss(scene.target.to(device))
    taken = []
    for _ in range(UNTIMED + ROUNDS):
        start = time.perf_counter()
        scales, opacities = params["log_scales"].exp(), params["logit_opacities"].sigmoid()
        render = dispatch.rasterize(
            params["means"], params["quats"], scales, opacities, params["sh"], scene.T_world_camera, scene.K,
            case.width, case.height, channels=case.channels,
        )  # fmt: skip
        assert render.rgb is not None
        further = sum(
            (1e-7 * image.sum() for image in (render.depth, render.normal, render.alpha) if image is not None),
            torch.zeros((), device=device),
        )
        (loss(render.rgb) + further).backward()
        adam.step()
        adam.zero_grad()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        taken.append(1e3 * (time.perf_counter() - start))
    return sorted(taken[UNTIMED:])[ROUNDS // 2]
