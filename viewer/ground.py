"""The ground: a level grid below what was photographed, for the eye to hold on to, with the world's axes on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.viewer.moment import Moment
from splatnode.viewer.shapes import Colour, Lines
from splatnode.viewer.viewpoint import scene_pivot, scene_spread, scene_up

Array = npt.NDArray[np.float64]

GRID_COLOUR: Colour = (0.45, 0.47, 0.51)
AXES: tuple[tuple[str, Colour], ...] = (("x", (1.0, 0.35, 0.3)), ("y", (0.4, 0.9, 0.35)), ("z", (0.4, 0.6, 1.0)))
_LOWEST = 2.0  # percent of the Gaussians around the middle may lie below the grid
_AROUND = 3.0  # times the median distance from the middle: what is farther has no say
_REACH = 2.0  # times the same distance, from the middle of the grid to its edge
_CELLS = 12  # at most, from edge to edge
_LEAST = 1e-12  # length of a step, in the unit of the world


@dataclass(frozen=True, eq=False)
class Ground:
    """A level square."""

    centre: Array  # (3,)
    up: Array  # (3,) unit
    cell: float  # the width of a cell of its grid, in the world's unit
    cells: int  # from its centre to an edge

    def height(self, point: Array) -> float:
        """How far the point (3,) is above it."""
        return float((point - self.centre) @ self.up)


def ground(moment: Moment) -> Ground | None:
    """The plane below the scene that is level by the cameras; None where there are no Gaussians.

    The cells are 1, 2 or 5 times a power of ten wide, in the world's unit: metres where the scale is known.
    """
    means = moment.snapshot.gaussians.means
    if not len(means):
        return None
    up, pivot = scene_up(moment.snapshot.cameras), scene_pivot(moment)
    spread = scene_spread(moment, pivot)
    offsets = means - pivot
    near = offsets[np.linalg.norm(offsets, axis=1) < _AROUND * spread]
    centre = pivot + float(np.percentile((near if len(near) else offsets) @ up, _LOWEST)) * up
    cell = round_number(2.0 * _REACH * spread / _CELLS)
    return Ground(centre, up, cell, max(1, math.floor(_REACH * spread / cell)))


def ground_lines(there: Ground | None) -> tuple[Lines, ...]:
    """The grid, and from its middle the world's axes, a cell long: x red, y green, z blue."""
    if there is None:
        return ()
    first = np.cross(there.up, [1.0, 0.0, 0.0] if abs(there.up[0]) < 0.9 else [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    second = np.cross(there.up, first)
    steps = there.cell * np.arange(-there.cells, there.cells + 1)[:, None]
    edge = there.cell * there.cells
    ends = [
        np.stack([there.centre + steps * one - edge * other, there.centre + steps * one + edge * other], axis=1)
        for one, other in ((first, second), (second, first))
    ]
    axes = [
        Lines(np.array([[there.centre, there.centre + there.cell * direction]]), colour, 2)
        for direction, (_, colour) in zip(np.eye(3), AXES, strict=True)
    ]
    return (Lines(np.concatenate(ends), GRID_COLOUR, 1), *axes)


def round_number(least: float) -> float:
    """The smallest of 1, 2, 5, 10, 20 ..., or of 0.5, 0.2, 0.1 ..., that is at least `least`, within 1e-12 and 1e12."""
    least = min(max(least, _LEAST), 1.0 / _LEAST)
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least * (1 - 1e-9))
