"""How wrong an estimated camera may be: bounds on its errors, each of which holds for 95 % of all cameras.

Rotations are counted after the best common rotation, centres after the best similarity: of photographs alone, the
world's place, direction and scale are not known.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Bounds:
    """95 % bounds of one camera's errors."""

    rotation_deg: float  # degrees
    centre: float  # in the unit of the world: metres where it is metric
    centre_percent: float  # the same, of the distance to the scene: the median depth of its points
    focal_percent: float  # of the focal length

    def scaled(self, factor: float) -> Bounds:
        """The same in a world whose unit is `factor` times smaller."""
        return replace(self, centre=self.centre * factor)


def widest(bounds: Iterable[Bounds]) -> Bounds | None:
    """The widest bound of each kind; None without any."""
    every = list(bounds)
    if not every:
        return None
    return Bounds(
        rotation_deg=max(each.rotation_deg for each in every),
        centre=max(each.centre for each in every),
        centre_percent=max(each.centre_percent for each in every),
        focal_percent=max(each.focal_percent for each in every),
    )
