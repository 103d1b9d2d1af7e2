"""The interface of losses beside the photometric one. A new loss is one new file in this folder.

Its module has a `Config`, a subclass of Schedule with what is particular to it, and
`prepare(config, supervision, seed) -> Loss`. A configuration names it by its module, under
`optimize.regularizers.losses`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec
from torch import Tensor

from splatnode.capture.process.config import Internal, Plugin
from splatnode.recon.rasterize.reference import Render


class LossChoice(Plugin):
    """A loss: a module of splatnode.recon.optimize.losses with `Config` and `prepare(config, supervision, seed)`."""

    package = "splatnode.recon.optimize.losses"
    needs = ("Config", "prepare")


class Schedule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The weight of a loss, and the part of the refinement in which it counts."""

    weight: float = 0.0  # factor of the loss in the sum of all; 0: it does not count
    start: Internal[float] = 0.0  # share of the iterations after which it counts
    end: Internal[float] = 1.0  # share of the iterations after which it counts no more

    def weight_at(self, progress: float) -> float:
        """The weight at `progress` in [0, 1]."""
        return self.weight if self.start <= progress < self.end else 0.0


# Index of a view, and its render at the size of the view or half of it -> unweighted loss, a scalar with gradients.
Evaluate = Callable[[int, Render], Tensor]


@dataclass(frozen=True, eq=False)
class Loss:
    """A loss that is ready to be evaluated. Where both functions are None it cannot serve, and `served_by` says why."""

    served_by: str  # the network or measure behind it, for the report
    channels: tuple[str, ...] = ("rgb",)  # fields of Render that it compares
    on_training_view: Evaluate | None = None  # by the index of a photograph
    on_pseudo_view: Evaluate | None = None  # by the index of a pseudo view
