"""The interface of density controls: what adds and takes away Gaussians while they are being optimised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from splatnode.capture.process.config import Plugin
from splatnode.recon.optimize.target import Target
from splatnode.recon.scene.gaussians import Gaussians


class ControlChoice(Plugin):
    """What changes the number of Gaussians: a module of splatnode.recon.optimize.control."""

    package = "splatnode.recon.optimize.control"
    needs = ("Config", "load")


@dataclass(frozen=True, eq=False)
class Step:
    """An iteration that the optimiser has just made."""

    iteration: int  # 1 for the first
    iterations: int  # how many there are to be, if time allows
    progress: float  # in [0, 1]: how much of the refinement had been done before this step, by iterations and by time
    view: int  # index of the training view that was rendered
    gaussians: Gaussians  # the optimiser's own, after the step; `.grad` is still that of the step. Not to be written to
    Ts_world_camera: Sequence[Tensor]  # (4, 4) each, of all training views, as they are now
    targets: Sequence[Target]  # their photographs, at the resolution of this step
    max_gaussians: int | None  # how many there may be at the end


@dataclass(frozen=True, eq=False)
class Change:
    """What the optimiser goes on with."""

    gaussians: Gaussians  # M of them, not leaves
    origin: Tensor  # (M,) int64: the one before the change whose moments each goes on with; -1: it starts with none


class Control(Protocol):
    """A loaded density control. Its file has `Config` and `load(config, seed)`."""

    def after_step(self, step: Step) -> Change | None:
        """What changes now; None: nothing. Called after every iteration."""
        ...
