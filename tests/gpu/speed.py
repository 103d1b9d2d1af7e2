"""Milliseconds of an iteration on a device, of scenes that are made up and of the built-in capture, and of its parts.

The made-up scenes are those that `python -m tests.bench rasterize` times on the core.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import torch
from msgspec import structs
from torch import Tensor

from splatnode.capture.cameras import synthetic
from splatnode.extras.evaluate.methods import extract_start_config, find_start
from splatnode.recon import rasterize
from splatnode.recon.config import preset
from splatnode.recon.modelling import create_initial_scene
from splatnode.recon.optimize.fit import Adam
from splatnode.recon.optimize.photometric_losses import PhotometricLoss
from splatnode.recon.optimize.training import RefinementConfig, refine
from splatnode.recon.scene import Scene
from tests.bench.speed.rasterize import CASES, LRS, Case, bumpy_surface

ROUNDS, UNTIMED = 30, 5
STEPS = 150  # of the refinement of the built-in capture


def milliseconds(device: torch.device) -> dict[str, float]:
    """By what is timed: the median of an iteration (image, loss, gradients, Adam), and of its parts one by one."""
    found: dict[str, float] = {}
    for case in CASES:
        iteration = _Iteration(case, device)
        found[f"{case.name}, ms an iteration"] = _median(_elapsed(iteration.step, device))
        for name, value in iteration.parts().items():
            found[f"{case.name}, ms of which {name}, waited for"] = value
    return found


class _Iteration:
    """One scene and its optimiser."""

    def __init__(self, case: Case, device: torch.device) -> None:
        scene = bumpy_surface(case)
        self._case, self._device = case, device
        self._camera = scene.T_world_camera, scene.K
        self._params = {
            name: param.detach().to(device).requires_grad_() for name, param in scene.params.items() if name != "twist"
        }
        self._adam = Adam(self._params, {name: scene.lr_factor * LRS[name] for name in self._params})
        self._loss = PhotometricLoss(scene.target.to(device))

    def step(self, after_part: Callable[[str], None] = lambda name: None) -> None:
        params, case = self._params, self._case
        render = rasterize.rasterize(
            params["means"], params["quats"], params["log_scales"].exp(), params["logit_opacities"].sigmoid(),
            params["sh"], *self._camera, case.width, case.height, channels=case.channels,
        )  # fmt: skip
        after_part("image")
        assert render.rgb is not None
        loss: Tensor = self._loss(render.rgb)
        after_part("loss")
        for image in (render.depth, render.normal, render.alpha):
            loss = loss if image is None else loss + 1e-7 * image.sum()
        loss.backward()
        after_part("gradients")
        self._adam.step()
        self._adam.zero_grad()
        after_part("Adam")

    def parts(self) -> dict[str, float]:
        """The medians in ms, each part finished before the next one begins: together longer than an iteration."""
        taken: dict[str, list[float]] = {}
        for _ in range(UNTIMED + ROUNDS):
            last = time.perf_counter()

            def mark(name: str) -> None:
                nonlocal last
                _wait(self._device)
                now = time.perf_counter()
                taken.setdefault(name, []).append(1e3 * (now - last))
                last = now

            self.step(mark)
        return {name: _median(times) for name, times in taken.items()}


def refinement_ms(device: torch.device) -> dict[str, float]:
    """The median of an iteration of the built-in capture's refinement on the processor and on `device`."""
    config = preset("balanced")
    steps = structs.replace(config.optimize, iterations=STEPS, checkpoints=())
    scene = create_initial_scene(
        find_start(list(synthetic.stream(synthetic.Config())), extract_start_config(config)).estimate, config
    )
    assert scene is not None  # the built-in capture is known to give one
    found: dict[str, float] = {}
    for on in (torch.device("cpu"), device):
        taken = list(_between_steps(scene.move_to_device(on), steps))
        name = f"built-in capture, balanced, {len(scene.gaussians)} Gaussians at first, on {on.type}"
        found[f"{name}, ms an iteration"] = _median(taken)
        found[f"{name}, s of the first iteration"] = 1e-3 * taken[0]
    return found


def _between_steps(scene: Scene, steps: RefinementConfig) -> Iterator[float]:
    """Milliseconds from the end of each step to that of the next one."""
    times = [time.perf_counter()]
    for _ in refine(scene, steps, seed=0, gone_on=lambda _: times.append(time.perf_counter())):
        pass
    return (1e3 * (later - earlier) for earlier, later in pairwise(times))


def _elapsed(step: Callable[[], None], device: torch.device) -> Iterator[float]:
    for _ in range(UNTIMED + ROUNDS):
        start = time.perf_counter()
        step()
        _wait(device)
        yield 1e3 * (time.perf_counter() - start)


def _median(taken: Iterator[float] | list[float]) -> float:
    timed = sorted(list(taken)[UNTIMED:])
    return timed[len(timed) // 2]


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
