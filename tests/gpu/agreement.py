"""How far a GPU's results are from those of the processor: figures, each with the bound that it must keep."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from msgspec import structs
from torch import Tensor

from splatnode.capture.cameras import folder as folder_camera
from splatnode.capture.cameras import synthetic
from splatnode.extras.evaluate.dataset import write_capture
from splatnode.extras.evaluate.runner import evaluate_held_out_views
from splatnode.recon import rasterize as dispatch
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.optimize.control import ControlChoice, prune
from splatnode.recon.optimize.fit import Adam
from splatnode.recon.optimize.photometric_losses import PhotometricLoss
from splatnode.recon.optimize.training import RefinementConfig, refine
from splatnode.recon.pipeline import run
from splatnode.recon.rasterize import Device, reference
from splatnode.recon.scene import Scene
from tests.support.known_scene import disturbed, photographed, render, turned
from tests.support.rasterize_cases import HEIGHT, NAMES, WIDTH, Case, images, moderate, relative_error

# How the device's part of a comparison is computed: as it is, or with something in a GPU's place.
Computing = Callable[[], AbstractContextManager[None]]


@dataclass(frozen=True)
class Figure:
    """A difference between device and processor; NaN keeps no bound."""

    name: str
    value: float
    bound: float

    @property
    def kept(self) -> bool:
        return abs(self.value) <= self.bound


def figures(
    device: torch.device, iterations: int = 60, computing: Computing = contextlib.nullcontext
) -> Iterator[Figure]:
    """All parts of a refinement one by one, then a refinement of so many iterations."""
    for antialias, known in itertools.product((False, True), repeat=2):
        yield from _rasterizer(device, antialias, known, computing)
    yield from _loss(device, computing)
    yield _adam(device, computing)
    yield from _refinement(device, iterations, computing)


def _rasterizer(device: torch.device, antialias: bool, known: bool, computing: Computing) -> Iterator[Figure]:
    """The largest difference of a pixel, and of each gradient relative to its norm, over three random views.

    As a refinement renders, intrinsics are `known`, so that they have no gradient, and colours have one term.
    """
    words = ("antialiased " if antialias else "") + ("known intrinsics, plain colours, " if known else "")
    names = NAMES[:-1] if known else NAMES
    largest: dict[str, float] = {}
    for seed in range(3):
        case = moderate(seed)
        case = replace(case, sh=case.sh[:, :1]) if known else case
        expected = _rendered(case, torch.device("cpu"), torch.float64, reference.rasterize, antialias, known)
        with computing():
            actual = _rendered(case, device, torch.float32, dispatch.rasterize, antialias, known)
        pixels = max(float((a - e).abs().max()) for a, e in zip(actual[0], expected[0], strict=True))
        errors = [relative_error(a, e) for a, e in zip(actual[1], expected[1], strict=True)]
        for name, value in (("a pixel", pixels), *zip((f"gradient of {name}" for name in names), errors, strict=False)):
            largest[name] = max(largest.get(name, 0.0), value)
    for name, value in largest.items():
        yield Figure(f"{words}render: {name}", value, 2e-3 if name == "a pixel" else 1e-2)


def _rendered(
    case: Case, device: torch.device, dtype: torch.dtype, rasterize: Callable, antialias: bool, known: bool
) -> tuple[list[Tensor], list[Tensor]]:
    """Images and gradients of the sum of their squares, on the processor in float64.

    Depth counts as far as there is something: where alpha is next to nothing, rounding decides which splats it is of.
    """
    leaves = [tensor.detach().to(device).requires_grad_() for tensor in case.tensors(dtype)]
    leaves[-1].requires_grad_(not known)
    whole = rasterize(*leaves, WIDTH, HEIGHT, antialias=antialias)
    shown = [*images(replace(whole, depth=None)), whole.depth * whole.alpha]
    torch.stack([(image**2).mean() for image in shown]).sum().backward()
    gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]
    return [image.detach().cpu().double() for image in shown], [each.cpu().double() for each in gradients]


def _loss(device: torch.device, computing: Computing) -> Iterator[Figure]:
    generator = torch.Generator().manual_seed(0)
    target, noise = (torch.rand(90, 120, 3, generator=generator) for _ in range(2))
    weights = (torch.rand(90, 120, generator=generator) > 0.2).float()

    def evaluated(on: torch.device) -> tuple[float, Tensor]:
        rgb = (0.7 * target + 0.3 * noise).to(on).requires_grad_()
        value = PhotometricLoss(target.to(on), 0.4, weights.to(on))(rgb)
        value.backward()
        assert rgb.grad is not None
        return float(value.detach()), rgb.grad.cpu()

    expected, gradient = evaluated(torch.device("cpu"))
    with computing():
        actual, other = evaluated(device)
    yield Figure("photometric loss, relative", actual / expected - 1, 1e-4)
    yield Figure("its gradient", relative_error(other, gradient), 1e-3)


def _adam(device: torch.device, computing: Computing) -> Figure:
    def after_steps(on: torch.device) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        param = torch.randn(500, 3, generator=generator).to(on).requires_grad_()
        adam = Adam({"x": param}, {"x": 1e-2})
        for _ in range(10):
            param.grad = torch.randn(500, 3, generator=generator).to(on)
            adam.step()
        return param.detach().cpu()

    expected = after_steps(torch.device("cpu"))
    with computing():
        return Figure(
            "ten steps of Adam, of which each is .01", float((after_steps(device) - expected).abs().max()), 1e-4
        )


def _refinement(device: torch.device, iterations: int, computing: Computing) -> Iterator[Figure]:
    """The same disturbed scene refined on both, with dropout and pruning: renders of both ends, and their numbers."""
    truth = photographed()
    begun = turned(disturbed(truth))
    config = structs.replace(
        RefinementConfig(),
        iterations=iterations,
        checkpoints=(),
        control=ControlChoice("prune", prune.Config(min_iterations=0)),
    )

    def refined(on: torch.device) -> Scene:
        *_, end = refine(begun.move_to_device(on), config, seed=0)
        return end.move_to_device(torch.device("cpu"))

    expected = refined(torch.device("cpu"))
    with computing():
        actual = refined(device)
    quality = [_psnr(end, truth) for end in (actual, expected)]
    yield Figure(f"{iterations} iterations: PSNR on the photographs, dB", quality[0] - quality[1], 0.3)
    share = len(actual.gaussians) / len(expected.gaussians) - 1
    yield Figure(f"{iterations} iterations: number of Gaussians, relative", share, 0.05)


def _psnr(scene: Scene, truth: Scene) -> float:
    """Of the scene's renders from its own cameras against the photographs of `truth`, in dB."""
    squared = [
        ((render(scene.gaussians, view) - torch.from_numpy(known.image) / 255) ** 2).mean()
        for view, known in zip(scene.views, truth.views, strict=True)
    ]
    return float(-10 * torch.log10(torch.stack(squared).mean()))


def whole_figures(device: Device, folder: Path, preset_name: str = "fast") -> tuple[list[Figure], dict[str, float]]:
    """The built-in capture reconstructed on both: held-out views' differences, and the seconds of each refinement."""
    split = write_capture(folder, synthetic.Config())
    scores, seconds = [], {}
    for on in ("cpu", device):
        config = apply_changes(preset(preset_name), {"device": on})
        snapshot = run(folder_camera.stream(folder_camera.Config(folder=folder / "images", names=split.train)), config)
        scores.append(evaluate_held_out_views(snapshot, folder, split, on))
        seconds[f"built-in capture, {preset_name}, refinement on {on}, s"] = snapshot.seconds["optimise"]
    differences = {name: float(scores[1][name] or 0) - float(scores[0][name] or 0) for name in ("psnr", "ssim")}
    return [
        Figure("built-in capture: held-out PSNR, dB", differences["psnr"], 0.3),
        Figure("built-in capture: held-out SSIM", differences["ssim"], 0.005),
    ], seconds
