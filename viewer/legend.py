"""The legend: a scale bar with its unit, the world's axes and which way is up, right before the eye.

It is made of lines and labels in the world, so that every engine draws it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.scale import Scale
from splatnode.viewer.ground import AXES, round_number
from splatnode.viewer.lengths import format_length
from splatnode.viewer.shapes import Colour, Label, Lines, Shapes
from splatnode.viewer.viewpoint import Viewpoint

Array = npt.NDArray[np.float64]

COLOUR: Colour = (0.95, 0.95, 0.95)
_AHEAD = 0.12  # world units from the eye, where Open3D does not cut lines off; little of a scene is nearer
_LONGEST = 0.25  # of the picture's width, the scale bar
_MARGIN = 20.0  # pixels from the picture's edges
_TICK = 5.0  # pixels, at the ends of the bar
_RADIUS = 34.0  # pixels, of the axes
_BESIDE = 1.3  # times the length of an axis, to its letter


def legend(view: Viewpoint, width: int, height: int, scale: Scale) -> Shapes:
    """The bar at the lower left and the axes at the lower right of a picture of this size."""
    length = bar_length(view, width, height)
    pixels = length / _units_per_pixel(view, width, height)
    left, bottom = _MARGIN, height - _MARGIN
    strokes = np.array(
        [
            [[left, bottom], [left + pixels, bottom]],
            [[left, bottom - _TICK], [left, bottom + _TICK]],
            [[left + pixels, bottom - _TICK], [left + pixels, bottom + _TICK]],
        ]
    )
    bar = Lines(_unproject_near(strokes, view, width, height), COLOUR, 2)
    says = Label(
        format_length(length, scale),
        _unproject_near(np.array([left + 4.0, bottom - 14.0]), view, width, height),
        COLOUR,
    )
    middle = np.array([width - _MARGIN - 1.4 * _RADIUS, height - _MARGIN - 1.4 * _RADIUS])
    directions = [*zip(np.eye(3), AXES, strict=True), (view.up, ("up", COLOUR))]
    axes = [_axis(direction, name, colour, middle, view, (width, height)) for direction, (name, colour) in directions]
    return Shapes((bar, *(lines for lines, _ in axes)), (), (says, *(label for _, label in axes)))


def bar_length(view: Viewpoint, width: int, height: int) -> float:
    """1, 2 or 5 times a power of ten, in the world's unit, as long as fits at the depth that orbits go around."""
    longest = _LONGEST * width * _units_per_pixel(view, width, height)
    return 1.0 / round_number(1.0 / longest)


def _units_per_pixel(view: Viewpoint, width: int, height: int) -> float:
    """World units that a pixel covers at the pivot's depth."""
    return view.distance / float(view.K(width, height)[0, 0])


def _axis(
    direction: Array, name: str, colour: Colour, middle: Array, view: Viewpoint, size: tuple[int, int]
) -> tuple[Lines, Label]:
    """A line from the `middle` (2,) in pixels along a direction of the world (3,), and its name behind the tip."""
    flat = _RADIUS * (view.T_world_camera[:3, :3].T @ direction)[:2]
    ends = _unproject_near(np.array([[middle, middle + flat]]), view, *size)
    beside = middle + _BESIDE * flat + [-4.0, 4.0]  # a label begins at its lower left
    return Lines(ends, colour, 2), Label(name, _unproject_near(beside, view, *size), colour)


def _unproject_near(pixels: Array, view: Viewpoint, width: int, height: int) -> Array:
    """(..., 3) world points right before the eye that are seen at the pixels (..., 2)."""
    K = view.K(width, height)
    rays = np.concatenate([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((*pixels.shape[:-1], 1))], axis=-1)
    return _AHEAD * rays @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
