"""Pruning of Gaussians without which no view, photographed or not, would look different."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import torch
from torch import Tensor

from splatnode.capture.process.config import Internal
from splatnode.recon.optimize.control import GaussianChange, OptimizerStep
from splatnode.recon.optimize.regularizers import sample_pseudo_views
from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.scene import Gaussians
from splatnode.recon.scene.background import SHELL
from splatnode.recon.scene.initialization import REFERENCE_PX, visibility


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    at: tuple[float, ...] = (0.3,)  # shares of the refinement, rising, after which Gaussians are pruned
    # Less is not seen: squared difference of colours in [0, 1], over all pixels, channels, views
    least_change: float = 0.005
    between: Internal[int] = 1  # pseudo views for each photograph, which count as photographs do
    off_path: Internal[float] = 0.3  # largest distance of pseudo views from the path of the cameras, in its steps
    probes: Internal[int] = 2  # random images for each view, from which the differences are estimated
    # With a deadline, nothing is pruned before: until then the Gaussians are not fitted.
    min_iterations: Internal[int] = 30
    # Nor with fewer left: pruning takes the time of 30, and closing the gaps takes as many again.
    min_remaining_iterations: Internal[int] = 60


def load(config: Config, seed: int) -> Pruning:
    return Pruning(config, seed)


class Pruning:
    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._generator = torch.Generator().manual_seed(seed)
        self._rng = np.random.default_rng(seed)
        self._due = list(config.at)

    def after_step(self, step: OptimizerStep) -> GaussianChange | None:
        if not self._due or step.progress < self._due[0] or not self._is_due(step):
            return None
        while self._due and step.progress >= self._due[0]:
            self._due.pop(0)
        gaussians = step.gaussians.map(Tensor.detach)
        cameras = [Camera(T, i.K, i.width, i.height) for T, i in zip(step.Ts_world_camera, step.images, strict=True)]
        count, off_path = self._config.between * len(cameras), self._config.off_path
        # What is hidden in all photographs shows between them.
        cameras += [view.camera for view in sample_pseudo_views(cameras, count, off_path=off_path, rng=self._rng)]
        worth = estimate_removal_changes(gaussians, cameras, self._config.probes, self._generator)
        worth[gaussians.source_frame == SHELL] = torch.inf  # the far shell is for what no photograph shows
        kept = select_most_worthwhile(worth, self._config.least_change, step.max_gaussians)
        return GaussianChange(gaussians.subset(kept), kept)

    def _is_due(self, step: OptimizerStep) -> bool:
        """Whether the Gaussians have been, and can still be, fitted for long enough, or are more than allowed.

        The iterations that are left follow from the progress, which a deadline hastens.
        """
        needed_before = min(self._config.min_iterations, self._due[0] * step.iterations)
        left = step.iteration * (1.0 - step.progress) / max(step.progress, 1e-9)
        # Half of what the plan leaves after pruning: a plan that is short from the start is no deadline.
        needed_after = min(self._config.min_remaining_iterations, 0.5 * (1.0 - self._due[0]) * step.iterations)
        too_many = step.max_gaussians is not None and len(step.gaussians) > step.max_gaussians
        return (step.iteration > needed_before and left >= needed_after) or too_many


def select_most_worthwhile(worth: Tensor, least: float, limit: int | None) -> Tensor:
    """The indices, rising, of Gaussians of at least that `worth` (N,); the best `limit` of them where they are more."""
    kept = (worth >= least).nonzero()[:, 0]
    if limit is not None and len(kept) > limit:
        kept = worth.topk(limit).indices.sort().values
    return kept


def estimate_removal_changes(
    gaussians: Gaussians, cameras: Sequence[Camera], probes: int, generator: torch.Generator
) -> Tensor:
    """(N,) the squared visible difference to all images together if one Gaussian is left out: an estimate.

    What a pixel shows is linear in each opacity, so leaving a Gaussian out changes it by opacity * derivative.
    The sum over pixels of these squares is the mean square of their sum with random signs (Hutchinson 1990), which
    costs no more than a gradient. Pixels count as if the images were REFERENCE_PX wide.
    """
    opacities = gaussians.opacities.requires_grad_(True)
    total = torch.zeros_like(gaussians.logit_opacities)
    for camera in cameras:
        scale = max(camera.width, camera.height) / REFERENCE_PX
        rgb = render_gaussians(gaussians, camera, opacities=opacities).rgb
        assert rgb is not None  # it was asked for
        visible = torch.from_numpy(visibility(rgb.detach().cpu().numpy(), scale)).to(rgb.device)
        for _ in range(probes):
            signs = torch.randint(0, 2, rgb.shape, generator=generator).to(rgb.device) * 2.0 - 1.0
            # Of a sum: of an image and weights torch would first load its symbolic shapes, for half a second.
            (gradient,) = torch.autograd.grad((signs * visible[..., None] * rgb).sum(), opacities, retain_graph=True)
            total += (gradient * opacities.detach() / scale) ** 2
    return total / probes
