"""Takes away what explains less than it costs: Gaussians without which no view, photographed or not, would differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import torch
from torch import Tensor

from splatnode.recon.optimize.control.control import Change, Step
from splatnode.recon.optimize.pseudo_views import pseudo_views
from splatnode.recon.rasterize.gaussian_render import seen
from splatnode.recon.scene.background import SHELL
from splatnode.recon.scene.contrast_masking import visibility
from splatnode.recon.scene.gaussians import Gaussians
from splatnode.recon.scene.seeding import REFERENCE_PX


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    at: tuple[float, ...] = (0.3,)  # when this part of the refinement is done, rising
    least_change: float = 0.005  # squared visible difference of colours in [0, 1], over all pixels, channels, views
    between: int = 1  # views between the photographs, for each of these, that count as they do
    off_path: float = 0.3  # how far these may lie beside the path from photograph to photograph, in its steps
    probes: int = 2  # random images a view from which the differences are estimated
    settled: int = 30  # iterations after which it is told, in less time than was planned, what a Gaussian is worth
    afterwards: int = 60  # iterations for which there must be time: pruning takes that of 30, and the rest settles


@dataclass(frozen=True, eq=False)
class Camera:
    T_world_camera: Tensor  # (4, 4)
    K: Tensor  # (3, 3)
    width: int
    height: int


def load(config: Config, seed: int) -> Pruning:
    return Pruning(config, seed)


class Pruning:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._generator = torch.Generator().manual_seed(seed)
        self._rng = np.random.default_rng(seed)
        self._due = list(config.at)

    def after_step(self, step: Step) -> Change | None:
        if not self._due or step.progress < self._due[0] or not self._settled(step):
            return None
        while self._due and step.progress >= self._due[0]:
            self._due.pop(0)
        gaussians = step.gaussians.map(Tensor.detach)
        cameras = [Camera(T, t.K, t.width, t.height) for T, t in zip(step.Ts_world_camera, step.targets, strict=True)]
        cameras += between(cameras, self._config.between * len(cameras), self._config.off_path, self._rng)
        worth = changes_without(gaussians, cameras, self._config.probes, self._generator)
        # What the photographs do not show is what the far shell is for.
        worth[gaussians.source_frame == SHELL] = torch.inf
        kept = most_worth(worth, self._config.least_change, step.max_gaussians)
        return Change(gaussians.subset(kept), kept)

    def _settled(self, step: Step) -> bool:
        """Whether the Gaussians were, and can still be, fitted for long enough, or must become fewer all the same."""
        enough = min(self._config.settled, self._due[0] * step.iterations)
        left = step.iteration * (1.0 - step.progress) / max(step.progress, 1e-9)
        needed = min(self._config.afterwards, 0.5 * (1.0 - self._due[0]) * step.iterations)
        too_many = step.max_gaussians is not None and len(step.gaussians) > step.max_gaussians
        return (step.iteration > enough and left >= needed) or too_many


def most_worth(worth: Tensor, least: float, limit: int | None) -> Tensor:
    """The indices, rising, of what is worth at least that much; of these the best where they are more than `limit`."""
    kept = (worth >= least).nonzero()[:, 0]
    if limit is not None and len(kept) > limit:
        kept = worth.topk(limit).indices.sort().values
    return kept


def between(cameras: Sequence[Camera], count: int, off_path: float, rng: np.random.Generator) -> list[Camera]:
    """`count` views where no photograph was taken: what hides behind something in all photographs shows there."""
    if len(cameras) < 2:
        return []
    Ts_world_camera = [camera.T_world_camera.double().numpy() for camera in cameras]
    Ks = [camera.K.double().numpy() for camera in cameras]
    sizes = [(camera.width, camera.height) for camera in cameras]
    views = pseudo_views(Ts_world_camera, Ks, sizes, count, off_path=off_path, rng=rng)
    return [
        Camera(torch.from_numpy(view.T_world_camera).float(), torch.from_numpy(view.K).float(), view.width, view.height)
        for view in views
    ]


def changes_without(gaussians: Gaussians, cameras: Sequence[Camera], probes: int, generator: torch.Generator) -> Tensor:
    """(N,) the squared visible difference to all images together if one Gaussian is left out: an estimate.

    What a pixel shows is linear in each opacity, so that leaving a Gaussian out changes it by opacity * derivative.
    The sum over pixels of these squares is the mean square of their sum with random signs (Hutchinson 1990), which
    costs no more than a gradient. Pixels count as if the images were REFERENCE_PX wide.
    """
    opacities = gaussians.opacities.requires_grad_(True)
    total = torch.zeros(len(gaussians))
    for camera in cameras:
        scale = max(camera.width, camera.height) / REFERENCE_PX
        rgb = seen(gaussians, opacities, camera.T_world_camera, camera.K, camera.width, camera.height).rgb
        assert rgb is not None  # it was asked for
        visible = torch.from_numpy(visibility(rgb.detach().numpy(), scale))
        for _ in range(probes):
            signs = torch.randint(0, 2, rgb.shape, generator=generator) * 2.0 - 1.0
            # Of a sum: of an image and weights torch would first load its symbolic shapes, for half a second.
            (gradient,) = torch.autograd.grad((signs * visible[..., None] * rgb).sum(), opacities, retain_graph=True)
            total += (gradient * opacities.detach() / scale) ** 2
    return total / probes
