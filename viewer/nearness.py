"""What of a map is loaded at which detail: the near in full, the far coarsely, never more than a budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from splatnode.viewer.graph import FULL, NOTHING

FOCAL_PX = 1000.0  # of a window: from `FOCAL_PX * side` on, voxels of that side are smaller than its pixels


@dataclass(frozen=True)
class Extent:
    """How large the detail of a piece is, and how far it is from the eye."""

    away: float  # distance from the eye to the nearest of it, world units; 0: the eye is in it
    order: float  # the lower, the earlier it is served: the distance to the nearest of its cameras
    counts: tuple[int, ...]  # Gaussians at FULL detail, at level 1 and so on
    sides: tuple[float, ...]  # of the voxels of level 1 and so on, world units


def choose_levels(extents: Sequence[Extent], budget: int) -> tuple[int, ...]:
    """For each piece the level to show, or NOTHING where the budget of Gaussians does not suffice.

    A piece wants the coarsest level whose voxels are below a pixel from where the eye is. The nearest is served first:
    it gets what it wants as far as the farther ones still have something coarse, if that is possible at all.
    """
    nearest_first = sorted(range(len(extents)), key=lambda index: extents[index].order)
    chosen = [NOTHING] * len(extents)
    left = budget
    for index in nearest_first:  # the coarsest of each, as many as there is room for
        coarsest = len(extents[index].counts) - 1
        if extents[index].counts[coarsest] <= left:
            chosen[index] = coarsest
            left -= extents[index].counts[coarsest]
    for index in nearest_first:
        extent = extents[index]
        if chosen[index] == NOTHING:
            continue
        room = left + extent.counts[chosen[index]]
        better = [level for level in range(_choose_level(extent), chosen[index]) if extent.counts[level] <= room]
        if better:
            chosen[index] = better[0]
            left = room - extent.counts[better[0]]
    return tuple(chosen)


def _choose_level(extent: Extent) -> int:
    """The coarsest level that suffices from there."""
    enough = [level for level, side in enumerate(extent.sides, 1) if extent.away >= FOCAL_PX * side]
    return max(enough, default=FULL)
