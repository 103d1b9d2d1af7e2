"""How far apart two points are that the person clicks on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.scale import Scale
from splatnode.viewer.canvas import Canvas
from splatnode.viewer.lengths import format_length
from splatnode.viewer.shapes import Colour, Label, Lines, Shapes
from splatnode.viewer.viewpoint import Viewpoint

Array = npt.NDArray[np.float64]

COLOUR: Colour = (0.3, 1.0, 1.0)
_AROUND = 2  # pixels in each direction around the click, whose middle depth is taken
_CROSS = 0.012  # half the size of a point's mark, in parts of its distance from the eye


def surface_point(canvas: Canvas, view: Viewpoint, x: float, y: float) -> Array | None:
    """(3,) what is seen at a pixel of the picture; None where nothing is."""
    height, width = canvas.depth.shape
    column, row = int(x), int(y)
    if not (0 <= column < width and 0 <= row < height):
        return None
    near = np.s_[max(row - _AROUND, 0) : row + _AROUND + 1, max(column - _AROUND, 0) : column + _AROUND + 1]
    depths = canvas.depth[near]
    depths = depths[np.isfinite(depths)]
    if not len(depths):
        return None
    ray = np.linalg.solve(view.K(width, height), [x, y, 1.0])
    return view.T_world_camera[:3, :3] @ (float(np.median(depths)) * ray) + view.T_world_camera[:3, 3]


def add_point(points: tuple[Array, ...], point: Array) -> tuple[Array, ...]:
    """The points that are measured between after one more was clicked: a third one begins anew."""
    return (point,) if len(points) == 2 else (*points, point)


def measurement_lines(points: tuple[Array, ...], measuring: bool, scale: Scale) -> list[str]:
    """Describes the measurement between none, one or two points."""
    if len(points) == 2:
        source = f" ({scale.source})" if scale.metric and scale.source else ""
        said = f"{distance_words(points, scale)} between the two points{source}."
        return [said] if scale.metric else [said, "Lengths are relative: 1 is the median depth of the scene's points."]
    if not measuring:
        return []
    return ["Click the second point." if points else "Click two points of the scene."]


def distance_words(points: tuple[Array, ...], scale: Scale) -> str:
    return format_length(float(np.linalg.norm(points[1] - points[0])), scale)


def measurement_shapes(points: tuple[Array, ...], eye: Array, scale: Scale) -> Shapes:
    """A cross at each point (3,), as large from the `eye` (3,) wherever it is; between two a line with its length."""
    ends = [
        [point - step, point + step] for point in points for step in _CROSS * np.linalg.norm(point - eye) * np.eye(3)
    ]
    labels = ()
    if len(points) == 2:
        ends.append([points[0], points[1]])
        labels = (Label(distance_words(points, scale), (points[0] + points[1]) / 2.0, COLOUR),)
    return Shapes((Lines(np.array(ends), COLOUR, 2),) if ends else (), (), labels)
