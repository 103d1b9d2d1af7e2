"""The interface of density controls, which add and remove Gaussians while they are being optimised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from splatnode.capture.process.config import Plugin
from splatnode.recon.optimize.photometric_losses import TrainingImage
from splatnode.recon.scene import Gaussians


class ControlChoice(Plugin):
    """A density control: a module of splatnode.recon.optimize.control with `Config` and `load(config, seed)`."""

    package = "splatnode.recon.optimize.control"
    needs = ("Config", "load")


@dataclass(frozen=True, eq=False)
class OptimizerStep:
    """An iteration that the optimiser has just made."""

    iteration: int  # 1 for the first
    iterations: int  # planned; a deadline may allow fewer
    progress: float  # in [0, 1]: the share of the refinement done before this step, by iterations or by time
    view: int  # index of the training view that was rendered
    gaussians: Gaussians  # the optimiser's own, after the step; `.grad` is still that of the step. Not to be written to
    Ts_world_camera: Sequence[Tensor]  # (4, 4) each, of all training views, as they are now
    images: Sequence[TrainingImage]  # their photographs, at the resolution of this step
    max_gaussians: int | None  # allowed at the end; None: any number


@dataclass(frozen=True, eq=False)
class GaussianChange:
    """The Gaussians with which the optimiser goes on."""

    gaussians: Gaussians  # M of them, not leaves
    origin: Tensor  # (M,) int64: index before the change, whose Adam moments each goes on with; -1: moments of 0


class Control(Protocol):
    """A loaded density control. Its file has `Config` and `load(config, seed)`."""

    def after_step(self, step: OptimizerStep) -> GaussianChange | None:
        """The change after this iteration; None: no change. Called after every iteration."""
        ...
