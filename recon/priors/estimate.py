"""Estimate: what a prior says of a view graph, and the interface that every prior has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from recon.priors.pointmap import Pointmap
from recon.registration.register import Registration
from recon.view_graph import ViewGraph


@dataclass(frozen=True, eq=False)
class Estimate:
    """Cameras with evidence, and a point map for each of them. Both are empty when no cameras could be found."""

    registration: Registration | None
    pointmaps: tuple[Pointmap, ...]
    seconds_poses: float
    seconds_points: float


class Prior(Protocol):
    """A loaded prior. A prior file has `Config` and `load(config)`."""

    def estimate(self, graph: ViewGraph) -> Estimate:
        """Cameras and point maps of the keyframes that hang together, in one world frame."""
        ...
