"""What stands in the scene beside the Gaussians: frusta, photographs, where cameras may be, the path, the next view."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import Scale
from splatnode.viewer.analysis import Advice, camera_colours
from splatnode.viewer.state import Graph, Moment, ViewerState, edge_lines, node_marks
from splatnode.viewer.viewpoint import Canvas, Viewpoint, look_at, scene_depth, scene_pivot, scene_spread, scene_up

Array = npt.NDArray[np.float64]
Colour = tuple[float, float, float]

PATH_COLOUR: Colour = (0.95, 0.95, 0.95)
TRACKED_COLOUR: Colour = (0.2, 1.0, 0.3)
ADVICE_COLOUR: Colour = (1.0, 0.85, 0.1)
CHAIN_COLOUR: Colour = (0.2, 0.7, 1.0)
LOOP_COLOUR: Colour = (1.0, 0.25, 0.85)
RETRACTED_COLOUR: Colour = (0.5, 0.5, 0.5)
MARK_COLOURS: dict[bool, Colour] = {True: (0.4, 1.0, 0.5), False: (1.0, 0.45, 0.2)}  # by whether a scene is shown
_FRUSTUM = 0.12  # depth of a frustum in parts of the scene's depth
_AT_THE_EYE = 2.0  # times the depth of a frustum
_MIN_SIZE = 0.002  # of its distance from the eye: a smaller ellipsoid would be a dot in the window
_CORNERS = 24  # of an ellipse
_ROOM = 0.5  # of the distance to the nearest other camera: frusta do not run into each other


@dataclass(frozen=True, eq=False)
class Lines:
    ends: Array  # (M, 2, 3) world
    colour: Colour
    width: int  # pixels


@dataclass(frozen=True, eq=False)
class ImageQuad:
    """An image on its camera's frustum."""

    name: str
    corners: Array  # (4, 3) world: top left, top right, bottom right, bottom left
    levels: tuple[npt.NDArray[np.uint8], ...]  # (h, w, 3) RGB, each half as large as the one before


@dataclass(frozen=True, eq=False)
class Label:
    """A few letters that begin where a point of the world is seen."""

    text: str  # ASCII
    at: Array  # (3,) world
    colour: Colour


@dataclass(frozen=True, eq=False)
class Shapes:
    lines: tuple[Lines, ...]
    photographs: tuple[ImageQuad, ...]
    labels: tuple[Label, ...] = ()


def merge_shapes(*parts: Shapes) -> Shapes:
    """All of them."""
    return Shapes(
        tuple(lines for part in parts for lines in part.lines),
        tuple(photograph for part in parts for photograph in part.photographs),
        tuple(label for part in parts for label in part.labels),
    )


def shapes(
    moment: Moment,
    state: ViewerState,
    advice: Advice | None,
    tracked: CameraEstimate | None = None,
    eye: Array | None = None,
) -> Shapes:
    """All shapes that `state` shows, with the `tracked` live camera where it is known.

    A camera right at the `eye` (3,) has no shape: it would fill the window.
    """
    snapshot = moment.snapshot
    depth = frustum_depth(moment)
    others = [
        (index, camera)
        for index, camera in enumerate(snapshot.cameras)
        if eye is None or np.linalg.norm(camera.T_world_camera[:3, 3] - eye) > _AT_THE_EYE * depth
    ]
    lines, photographs, labels, colours = [], [], [], camera_colours(snapshot.cameras)
    if state.path and len(snapshot.cameras) > 1:
        lines.append(Lines(path(snapshot.cameras), PATH_COLOUR, 1))
    if state.cameras:
        for index, camera in others:
            corners = image_corners(camera, camera.T_world_camera, depth)
            lines.append(Lines(frustum(camera.T_world_camera, corners), colours[index], 2))
            if state.photographs and camera.name in moment.photographs:
                photographs.append(ImageQuad(camera.name, corners, moment.photographs[camera.name]))
    if state.given:
        lines += [
            Lines(draw_given_pose(camera, depth), colours[i], 1) for i, camera in others if camera.given is not None
        ]
    if state.graph and moment.graph is not None:
        lines += _graph(moment.graph)
    if state.uncertainty:
        for index, camera, axes in _select_uncertain_cameras(snapshot.cameras, eye):
            lines.append(Lines(ellipsoid(camera, axes), colours[index], 1))
    if state.tracked and tracked is not None and not state.follow:
        corners = image_corners(tracked, tracked.T_world_camera, 1.2 * depth)
        lines.append(Lines(frustum(tracked.T_world_camera, corners), TRACKED_COLOUR, 3))
    if state.advice and advice is not None and advice.arrow is not None and advice.target is not None:
        start, end = advice.arrow
        lines += advice_lines(snapshot.cameras, start, end, advice.target, depth)
        labels.append(Label("next view", end, ADVICE_COLOUR))
    return Shapes(tuple(lines), tuple(photographs), tuple(labels))


def _graph(graph: Graph) -> list[Lines]:
    """The scenes' marks, and lines between those that are linked; what no longer counts is dashed and grey."""
    kinds = [
        Lines(edge_lines(graph.edges, loop=loop, retracted=retracted), RETRACTED_COLOUR if retracted else colour, width)
        for loop, colour, width in ((False, CHAIN_COLOUR, 3), (True, LOOP_COLOUR, 4))
        for retracted in (False, True)
    ]
    marks = [Lines(node_marks(graph.nodes, good=good), colour, 3) for good, colour in MARK_COLOURS.items()]
    return [lines for lines in (*kinds, *marks) if len(lines.ends)]


def live_camera(moment: Moment, tracked: CameraEstimate | None) -> CameraEstimate | None:
    """The camera to follow: the tracked one, or else the one whose frame came last; None where there is none."""
    if tracked is not None:
        return tracked
    return max(moment.snapshot.cameras, key=lambda camera: camera.frame_id, default=None)


def frustum_depth(moment: Moment) -> float:
    """How deep frusta are drawn: visible from afar, but no deeper than half the way to the next camera."""
    largest = _FRUSTUM * scene_depth(moment)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in moment.snapshot.cameras])
    if len(centres) < 2:
        return largest
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    nearest = np.median(distances[~np.eye(len(centres), dtype=bool)].reshape(len(centres), -1).min(1))
    return float(np.clip(_ROOM * nearest, 0.03 * largest, largest))


def image_corners(lens: CameraEstimate, T_world_camera: Array, depth: float) -> Array:
    """(4, 3) world positions of the image's corners on the plane `depth` ahead of the camera."""
    pixels = np.array([[0, 0], [lens.width, 0], [lens.width, lens.height], [0, lens.height]], np.float64)
    rays = np.column_stack([(pixels - lens.K[:2, 2]) / lens.K[[0, 1], [0, 1]], np.ones(4)])
    return depth * rays @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def frustum(T_world_camera: Array, corners: Array) -> Array:
    """(10, 2, 3) a pyramid from the camera's centre to the corners, and a roof that tells which side is up."""
    centre = np.broadcast_to(T_world_camera[:3, 3], (4, 3))
    height = corners[0] - corners[3]
    top = (corners[0] + corners[1]) / 2.0 + 0.15 * height
    roof = np.stack([np.stack([corners[0], top]), np.stack([corners[1], top])])
    edges = np.stack([np.stack([centre, corners], 1), np.stack([corners, np.roll(corners, -1, 0)], 1)])
    return np.concatenate([*edges, roof])


def draw_given_pose(camera: CameraEstimate, depth: float) -> Array:
    """(11, 2, 3) a frustum at the pose that was given for the camera, and a line from there to where it is."""
    if camera.given is None:
        return np.zeros((0, 2, 3))
    T = camera.given.T_world_camera
    way = np.stack([T[:3, 3], camera.T_world_camera[:3, 3]])[None]
    return np.concatenate([frustum(T, image_corners(camera, T, depth)), way])


def ellipsoid(camera: CameraEstimate, axes: Array) -> Array:
    """(3 * 24, 2, 3) the ellipses around the camera's centre in the planes of each two of the semi-axes (3, 3)."""
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    rings = [
        np.outer(np.cos(angles), one) + np.outer(np.sin(angles), other)
        for one, other in zip(axes, np.roll(axes, -1, axis=0), strict=True)
    ]
    points = camera.T_world_camera[:3, 3] + np.stack(rings)
    return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)


def _select_uncertain_cameras(
    cameras: Sequence[CameraEstimate], eye: Array | None
) -> Iterator[tuple[int, CameraEstimate, Array]]:
    """The cameras whose ellipsoid is drawn, with their positions in the list and the semi-axes (3, 3).

    Not one that would be a dot from the `eye`, nor one that has the eye within it.
    """
    for index, camera in enumerate(cameras):
        if camera.bounds is None:
            continue
        axes = np.array(camera.bounds.axes)
        longest = float(np.linalg.norm(axes, axis=1).max())
        if eye is not None:
            away = float(np.linalg.norm(camera.T_world_camera[:3, 3] - eye))
            if not longest < away < longest / _MIN_SIZE:
                continue
        yield index, camera, axes


def path(cameras: tuple[CameraEstimate, ...]) -> Array:
    """(C - 1, 2, 3) from camera to camera in the order of their frames."""
    ordered = sorted(cameras, key=lambda camera: camera.frame_id)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in ordered])
    return np.stack([centres[:-1], centres[1:]], 1)


def advice_lines(
    cameras: tuple[CameraEstimate, ...], start: Array, end: Array, target: Array, depth: float
) -> tuple[Lines, Lines]:
    """A frustum at `end` that looks at `target`, as a camera there would, and the way there from the one at `start`."""
    T_world_camera = look_at(end, target, scene_up(cameras))
    corners = image_corners(cameras[0], T_world_camera, depth)
    way = Lines(np.array([[start, end]]), ADVICE_COLOUR, 1)
    return Lines(frustum(T_world_camera, corners), ADVICE_COLOUR, 2), way


# The ground: a level grid below what was photographed, for the eye to hold on to, with the world's axes on it.


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


# Lengths as a person reads them: in metres where the scale is known, otherwise with the word that says so.

_UNITS = ((1.0, "m"), (0.01, "cm"), (0.001, "mm"))  # metres of a unit and its sign, the largest first


def format_length(length: float, scale: Scale) -> str:
    """A length in the world's unit, to three digits: "42 cm", or "0.42 relative"."""
    if not scale.metric:
        return f"{_format_number(length)} relative"
    unit, sign = next((each for each in _UNITS if length >= each[0] * (1 - 1e-9)), _UNITS[-1])
    return f"{_format_number(length / unit)} {sign}"


def _format_number(value: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{float(f'{value:.3g}'):.10f}".rstrip("0").rstrip(".")


# The legend: a scale bar with its unit, the world's axes and which way is up, right before the eye.
#
# It is made of lines and labels in the world, so that every engine draws it.


LEGEND_COLOUR: Colour = (0.95, 0.95, 0.95)
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
    bar = Lines(_unproject_near(strokes, view, width, height), LEGEND_COLOUR, 2)
    says = Label(
        format_length(length, scale),
        _unproject_near(np.array([left + 4.0, bottom - 14.0]), view, width, height),
        LEGEND_COLOUR,
    )
    middle = np.array([width - _MARGIN - 1.4 * _RADIUS, height - _MARGIN - 1.4 * _RADIUS])
    directions = [*zip(np.eye(3), AXES, strict=True), (view.up, ("up", LEGEND_COLOUR))]
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


# How far apart two points are that the person clicks on.


MEASURING_COLOUR: Colour = (0.3, 1.0, 1.0)
_CLICK_RADIUS_PX = 2  # pixels in each direction around the click, whose middle depth is taken
_CROSS = 0.012  # half the size of a point's mark, in parts of its distance from the eye


def surface_point(canvas: Canvas, view: Viewpoint, x: float, y: float) -> Array | None:
    """(3,) what is seen at a pixel of the picture; None where nothing is."""
    height, width = canvas.depth.shape
    column, row = int(x), int(y)
    if not (0 <= column < width and 0 <= row < height):
        return None
    near = np.s_[
        max(row - _CLICK_RADIUS_PX, 0) : row + _CLICK_RADIUS_PX + 1,
        max(column - _CLICK_RADIUS_PX, 0) : column + _CLICK_RADIUS_PX + 1,
    ]
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
        labels = (Label(distance_words(points, scale), (points[0] + points[1]) / 2.0, MEASURING_COLOUR),)
    return Shapes((Lines(np.array(ends), MEASURING_COLOUR, 2),) if ends else (), (), labels)
