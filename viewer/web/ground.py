"""The ground grid: level lines below what was photographed, for the eye to hold on to."""

from __future__ import annotations

import math

import numpy as np

from splatnode.viewer.moment import Moment
from splatnode.viewer.shapes import Colour, Lines
from splatnode.viewer.viewpoint import scene_pivot, scene_spread, scene_up

GRID_COLOUR: Colour = (0.45, 0.47, 0.51)
_LOWEST = 2.0  # percent of the Gaussians around the middle may lie below the grid
_AROUND = 3.0  # times the median distance from the middle: what is farther has no say
_REACH = 2.0  # times the same distance, from the middle of the grid to its edge
_CELLS = 12  # at most, from edge to edge


def ground(moment: Moment) -> Lines:
    """Lines (M, 2, 3) on the plane below the scene that is level by the cameras; none where there are no Gaussians.

    The cells are 1, 2 or 5 times a power of ten wide, in the world's unit: metres where the scale is known.
    """
    means = moment.snapshot.gaussians.means
    if not len(means):
        return Lines(np.zeros((0, 2, 3)), GRID_COLOUR, 1)
    up, pivot = scene_up(moment.snapshot.cameras), scene_pivot(moment)
    spread = scene_spread(moment, pivot)
    offsets = means - pivot
    near = offsets[np.linalg.norm(offsets, axis=1) < _AROUND * spread]
    centre = pivot + float(np.percentile((near if len(near) else offsets) @ up, _LOWEST)) * up
    cell = _round_number(2.0 * _REACH * spread / _CELLS)
    count = max(1, math.floor(_REACH * spread / cell))
    first = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    steps, edge = cell * np.arange(-count, count + 1)[:, None], cell * count
    ends = [
        np.stack([centre + steps * one - edge * other, centre + steps * one + edge * other], axis=1)
        for one, other in ((first, second), (second, first))
    ]
    return Lines(np.concatenate(ends), GRID_COLOUR, 1)


def _round_number(least: float) -> float:
    """The smallest of 1, 2, 5, 10, 20 ..., or of 0.5, 0.2, 0.1 ..., that is at least `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least * (1 - 1e-9))
