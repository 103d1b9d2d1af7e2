"""All losses beside the photometric one together (equation 13), each with its weight at its time."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import msgspec
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.optimize.losses.loss import Evaluate, Loss, LossChoice, Schedule
from splatnode.recon.optimize.pseudo_views import PseudoView, pseudo_views
from splatnode.recon.optimize.supervision import Supervision
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.rasterize.render import Render


class RegularizerConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The losses, and what they share: pseudo views, and the points and depths that are trusted.

    Pseudo views have the full size: with half of it sceaux lost .29 dB, .005 SSIM and .016 LPIPS, because Gaussians of
    a pixel look different there.
    """

    losses: Mapping[str, LossChoice] = {}  # by names of your own, which the report uses; a weight of 0 costs nothing
    pseudo_views: int = 12  # how many views between the cameras are drawn for losses that need them
    off_path: float = 0.1  # largest distance of these from the cameras' path, in distances of neighbouring cameras
    nearest_points: int = 8  # points that are blended in a pixel (K of equation 6)
    min_confidence: float = 0.3  # least confidence of the points that are rendered and of the depths that are compared

    @property
    def active_losses(self) -> dict[str, LossChoice]:
        """The losses whose weight is not 0."""
        return {name: choice for name, choice in self.losses.items() if choice.config.weight}


class Regularizer:
    """The losses of one refinement; it draws the pseudo view of each iteration."""

    def __init__(
        self,
        pointmaps: Sequence[Pointmap],
        images: Sequence[npt.NDArray[np.uint8]],
        config: RegularizerConfig,
        *,
        seed: int,
        shown: Sequence[npt.NDArray[np.bool_]] | None = None,
    ) -> None:
        """`pointmaps` and `images` (h, w, 3) RGB are of the training views, in the order of `training_loss`.

        `shown` (h, w) are False where these photographs do not show the scene: what a network tells there is not used.
        """
        self._rng = np.random.default_rng(seed)
        self._pseudo_views = _sample_pseudo_views(pointmaps, config, self._rng)
        supervision = Supervision(
            images, pointmaps, self._pseudo_views, config.nearest_points, config.min_confidence, shown
        )
        losses = {
            name: choice.module.prepare(choice.config, supervision, seed)
            for name, choice in config.active_losses.items()
        }
        self._losses: list[tuple[Schedule, Loss]] = [
            (config.losses[name].config, loss) for name, loss in losses.items() if _is_usable(loss)
        ]
        self.served_by = {name: loss.served_by for name, loss in losses.items()}

    def channels(self, progress: float) -> tuple[str, ...]:
        """Returns the channels to render at this progress in [0, 1]: colours, and what active losses compare."""
        compared = [
            channel for schedule, loss in self._losses if schedule.weight_at(progress) for channel in loss.channels
        ]
        return tuple(dict.fromkeys(("rgb", *compared)))

    def training_loss(self, index: int, render: Render, progress: float) -> Tensor | None:
        """The losses on training view `index` (equation 11), weighted; None while none is active."""
        return _sum_losses(self._active(progress, lambda loss: loss.on_training_view), index, render)

    def pseudo_loss(self, draw: Callable[[PseudoView, Collection[str]], Render], progress: float) -> Tensor | None:
        """The losses on a random pseudo view, as `draw` renders its channels, weighted; None while none is active."""
        active = self._active(progress, lambda loss: loss.on_pseudo_view)
        if not self._pseudo_views or not active:
            return None
        index = int(self._rng.integers(len(self._pseudo_views)))
        return _sum_losses(active, index, draw(self._pseudo_views[index], self.channels(progress)))

    def _active(self, progress: float, function: Callable[[Loss], Evaluate | None]) -> list[tuple[float, Evaluate]]:
        """Weight and `function` of each loss that has it and counts at this progress."""
        found = [(schedule.weight_at(progress), function(loss)) for schedule, loss in self._losses]
        return [(weight, evaluate) for weight, evaluate in found if weight and evaluate is not None]


def _sum_losses(active: Sequence[tuple[float, Evaluate]], index: int, render: Render) -> Tensor | None:
    parts = [weight * evaluate(index, render) for weight, evaluate in active]
    return torch.stack(parts).sum() if parts else None


def _is_usable(loss: Loss) -> bool:
    return loss.on_training_view is not None or loss.on_pseudo_view is not None


def _sample_pseudo_views(
    pointmaps: Sequence[Pointmap], config: RegularizerConfig, rng: np.random.Generator
) -> list[PseudoView]:
    """The pseudo views; none between fewer than two cameras."""
    if len(pointmaps) < 2:
        return []
    return pseudo_views(
        [pointmap.T_world_camera for pointmap in pointmaps],
        [pointmap.K for pointmap in pointmaps],
        [(pointmap.depth.shape[1], pointmap.depth.shape[0]) for pointmap in pointmaps],
        config.pseudo_views,
        off_path=config.off_path,
        rng=rng,
    )
