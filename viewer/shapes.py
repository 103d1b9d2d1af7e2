"""What stands in the scene beside the Gaussians, and the picture of a moment, drawn on the processor."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import compute_base_rgb, select_gaussians
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import SHELL, CameraEstimate, GaussianArrays
from splatnode.recon.result.verdict import Scale
from splatnode.viewer.analysis import Advice, camera_colours
from splatnode.viewer.state import (
    BACKGROUND,
    NEAR,
    Canvas,
    FloatArray,
    Graph,
    Image,
    Moment,
    ViewerState,
    Viewpoint,
    edge_lines,
    empty_canvas,
    look_at,
    node_marks,
    scene_depth,
    scene_pivot,
    scene_spread,
    scene_up,
    transform_to_camera,
)

# What stands in the scene beside the Gaussians: frusta, photographs, where cameras may be, the path, the next view.

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


# The picture of a moment, drawn on the processor: Gaussians by the project's own rasteriser, the rest over them.
#
# It needs neither a display nor a graphics driver, and it is what the viewer shows where those are missing.
# While the person drags, a picture is as fine as keeps up with the hand.

# Gaussians painted as points: squares of one size at their centres, the nearest on top.


def paint_points(
    gaussians: GaussianArrays, T_camera_world: FloatArray, K: FloatArray, size: int, width: int, height: int
) -> Canvas:
    """A canvas with squares of `size` pixels at the centres of the Gaussians."""
    points = transform_to_camera(gaussians.means, T_camera_world.astype(np.float32))
    ahead = np.flatnonzero(points[:, 2] > NEAR)
    z = points[ahead, 2]
    focal, corner = K[[0, 1], [0, 1]].astype(np.float32), (K[:2, 2] - size / 2 + 0.5).astype(np.float32)
    columns, rows = np.floor(points[ahead, :2] / z[:, None] * focal + corner).T
    seen = np.flatnonzero((columns > -size) & (columns < width) & (rows > -size) & (rows < height))
    order = seen[np.argsort(-z[seen])]
    columns, rows = columns[order].astype(np.intp), rows[order].astype(np.intp)
    # A frame around the picture takes what sticks out of it. The nearest owns a pixel: it has the largest number, and
    # the last assignment stays. Dilation makes squares of them (float32 holds whole numbers up to 2^24).
    wide = np.zeros((height + 2 * size, width + 2 * size), np.float32)
    wide[rows + size, columns + size] = np.arange(1, len(order) + 1, dtype=np.float32)
    squares = cv2.dilate(wide, np.ones((size, size), np.uint8), anchor=(size - 1, size - 1))
    owner = squares[size : size + height, size : size + width].astype(np.intp)  # 0, where nobody owns a pixel
    colours = np.zeros((len(order) + 1, 4), np.uint8)  # four bytes are one number, which is gathered at once
    colours[0, :3], colours[1:, :3] = BACKGROUND, compute_base_rgb(gaussians)[ahead[order]]
    depths = np.concatenate([np.array([np.inf], np.float32), z[order]])
    # Every owner is a valid index; "clip" spares take the buffer that its check would need.
    four = colours.view(np.uint32)[:, 0].take(owner, mode="clip")[..., None].view(np.uint8)
    return Canvas(np.asarray(cv2.cvtColor(four, cv2.COLOR_RGBA2RGB), np.uint8), depths.take(owner, mode="clip"))


# Photographs and lines painted among the Gaussians: what something hides is left out or dim.

_BEHIND = 1.02  # a shape this many times as far as the surface is behind it
_PIECES = 24  # that a line is cut into, each of them hidden or not
_LETTERS = 0.5  # of OpenCV's size: 11 pixels high
_HIDDEN = 0.3  # how much of a line's colour is left where it is behind something


def paint_shapes(canvas: Canvas, shapes: Shapes, T_camera_world: FloatArray, K: FloatArray) -> None:
    """The photographs, the nearest on top, and over them the lines."""
    in_front = [
        (transform_to_camera(photograph.corners, T_camera_world), photograph) for photograph in shapes.photographs
    ]
    for corners, photograph in sorted(in_front, key=lambda one: -float(one[0][:, 2].mean())):
        _paint_image(canvas, photograph, corners, K)
    _paint_lines(canvas, shapes.lines, T_camera_world, K)
    for label in shapes.labels:
        _paint_label(canvas, label, T_camera_world, K)


def _paint_image(canvas: Canvas, photograph: ImageQuad, corners: FloatArray, K: FloatArray) -> None:
    """The image on its rectangle (camera frame), where nothing is in front; not if that reaches behind the eye."""
    height, width = canvas.depth.shape
    if corners[:, 2].min() < NEAR:
        return
    pixels = (corners / corners[:, 2:]) @ K.T
    low = np.maximum(np.floor(pixels[:, :2].min(0)).astype(int), 0)
    high = np.minimum(np.ceil(pixels[:, :2].max(0)).astype(int), [width, height])
    if (high <= low).any():
        return
    image = _select_pyramid_level(photograph.levels, high - low)
    image_height, image_width = image.shape[:2]
    source = np.array([[0, 0], [image_width, 0], [image_width, image_height], [0, image_height]], np.float32) - 0.5
    target = (pixels[:, :2] - low - 0.5).astype(np.float32)
    homography = cv2.getPerspectiveTransform(source, target)
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    warped = cv2.warpPerspective(image, homography, size, flags=cv2.INTER_LINEAR)
    inside = cv2.warpPerspective(np.full((image_height, image_width), 255, np.uint8), homography, size) > 127
    box = np.s_[low[1] : high[1], low[0] : high[0]]
    nearness = _plane_nearness(corners, K, low, size)
    shown = inside & (_BEHIND * canvas.depth[box] * nearness >= 1.0)
    np.copyto(canvas.image[box], warped, where=shown[..., None])
    np.divide(1.0, nearness, out=canvas.depth[box], where=shown)


def _select_pyramid_level(levels: tuple[Image, ...], size: npt.NDArray[np.int_]) -> Image:
    """The smallest of the images that has at least 0.7 pixels for each of `size` (width, height): none flickers."""
    enough = [image for image in levels if (np.array([image.shape[1], image.shape[0]]) >= 0.7 * size).all()]
    return enough[-1] if enough else levels[0]


def _plane_nearness(
    corners: FloatArray, K: FloatArray, low: npt.NDArray[np.int_], size: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """(h, w) 1 / z, at the pixels of the box, of the plane through `corners` (camera frame): affine in the pixel."""
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    height = corners[0] @ normal  # over the eye; 0 where the plane is seen edge-on, and then it covers no pixel
    columns = (low[0] + np.arange(size[0]) + 0.5 - K[0, 2]) / K[0, 0]
    rows = (low[1] + np.arange(size[1]) + 0.5 - K[1, 2]) / K[1, 1]
    sums = (rows * normal[1] + normal[2])[:, None] + (columns * normal[0])[None]
    return (sums / (height if abs(height) > 1e-12 else np.inf)).astype(np.float32)


def _paint_lines(canvas: Canvas, groups: Sequence[Lines], T_camera_world: FloatArray, K: FloatArray) -> None:
    """Lines, bright where nothing is in front of them, dim where something is. All at once: there are many groups."""
    if not groups:
        return
    height, width = canvas.depth.shape
    ends = np.concatenate([group.ends for group in groups])
    group_of = [number for number, group in enumerate(groups) for _ in group.ends]
    steps = np.linspace(0.0, 1.0, _PIECES + 1)
    start, end = (transform_to_camera(ends[:, i], T_camera_world) for i in (0, 1))
    points = start[:, None] + steps[None, :, None] * (end - start)[:, None]  # (M, pieces + 1, 3)
    ahead = points[..., 2] > NEAR
    pixels = ((points / np.where(ahead, points[..., 2], 1.0)[..., None]) @ K.T)[..., :2]
    near_window = (np.abs(pixels) < 4 * max(width, height)).all(-1) & ahead
    columns, rows = ((pixels[:, :-1] + pixels[:, 1:]) / 2.0).transpose(2, 0, 1)
    surface = canvas.depth[np.clip(rows, 0, height - 1).astype(int), np.clip(columns, 0, width - 1).astype(int)]
    hidden = (points[:, :-1, 2] + points[:, 1:, 2]) / 2.0 > _BEHIND * surface
    drawable = near_window[:, :-1] & near_window[:, 1:]
    bright = [tuple(round(255 * value) for value in group.colour) for group in groups]
    for chosen, behind in ((drawable & hidden, True), (drawable & ~hidden, False)):
        pieces, line_of = _find_visible_segments(pixels, chosen)
        for piece, line in zip(np.rint((pieces - 0.5) * 16).astype(np.int32).tolist(), line_of, strict=True):
            colour, thick = bright[group_of[line]], groups[group_of[line]].width
            if behind:
                colour, thick = tuple(round(_HIDDEN * value + (1 - _HIDDEN) * 60) for value in colour), 1
            cv2.line(canvas.image, piece[0], piece[1], colour, thick, cv2.LINE_AA, 4)


def _paint_label(canvas: Canvas, label: Label, T_camera_world: FloatArray, K: FloatArray) -> None:
    """The letters on a dark plate, over everything else; not of a point that is behind the eye or far off."""
    at = transform_to_camera(label.at, T_camera_world)
    height, width = canvas.depth.shape
    if at[2] < NEAR:
        return
    pixel = (K @ (at / at[2]))[:2]
    if not (np.abs(pixel) < 2 * max(width, height)).all():
        return
    column, row = round(float(pixel[0])), round(float(pixel[1]))
    (wide, high), _ = cv2.getTextSize(label.text, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, 1)
    plate = canvas.image[max(row - high - 5, 0) : max(row + 6, 0), max(column - 5, 0) : max(column + wide + 5, 0)]
    plate[:] = plate // 3
    colour = tuple(round(255 * value) for value in label.colour)
    place = column, row
    cv2.putText(canvas.image, label.text, place, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, colour, 1, cv2.LINE_AA)


def _find_visible_segments(
    pixels: FloatArray, chosen: npt.NDArray[np.bool_]
) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """(R, 2, 2) ends of the parts of M lines (M, pieces + 1, 2) whose pieces are all `chosen`, (R,) of which line."""
    edges = np.diff(np.pad(chosen, ((0, 0), (1, 1))).astype(np.int8), axis=1)  # a line is straight in the picture too
    return np.stack([pixels[edges > 0], pixels[edges < 0]], 1), np.nonzero(edges > 0)[0]


# A scene seen from outside of its far shell, which would hide all that it surrounds: it is not drawn then.


def cull_far_shell(gaussians: GaussianArrays, eye: npt.NDArray[np.floating]) -> GaussianArrays:
    """Those that a viewer at `eye` (3,) is to see: all, or where it is outside of the far shell, all but that.

    Of a file that does not tell which these are, all.
    """
    shell = gaussians.source_frame == SHELL
    if not shell.any() or shell.all():
        return gaussians
    centre, radius = _fit_sphere(gaussians.means[shell].astype(np.float64))
    inside = float(np.linalg.norm(np.asarray(eye, np.float64) - centre)) < radius
    return gaussians if inside else select_gaussians(gaussians, ~shell)


def _fit_sphere(points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """Centre (3,) and radius of the sphere on which the points (N, 3) lie, by least squares.

    |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the centre c and in what is left.
    """
    middle = points.mean(0)
    there = points - middle
    unknowns = np.column_stack([2.0 * there, np.ones(len(there))])
    solution = np.linalg.lstsq(unknowns, (there * there).sum(1), rcond=None)[0]
    centre = solution[:3]
    return centre + middle, float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))


_LETTER = 8  # pixels, the width of a wide letter of a caption


def paint(
    gaussians: GaussianArrays, shapes: Shapes, view: Viewpoint, state: ViewerState, width: int, height: int
) -> Image:
    """(H, W, 3) RGB of the Gaussians, in the colours that they have, with the shapes among them."""
    K = view.K(width, height)
    return overlay_shapes(paint_gaussians(gaussians, view.T_world_camera, K, state, width, height), shapes, view)


def overlay_shapes(canvas: Canvas, shapes: Shapes, view: Viewpoint) -> Image:
    """(H, W, 3) RGB of what is on the canvas, with the shapes among it. The canvas stays as it is."""
    height, width = canvas.depth.shape
    copy = Canvas(canvas.image.copy(), canvas.depth.copy())
    paint_shapes(copy, shapes, np.linalg.inv(view.T_world_camera), view.K(width, height))
    return copy.image


def paint_gaussians(
    gaussians: GaussianArrays, T_world_camera: FloatArray, K: FloatArray, state: ViewerState, width: int, height: int
) -> Canvas:
    """The Gaussians on the background, as Gaussians or as points, or only the background."""
    if not state.gaussians or not len(gaussians):
        return empty_canvas(width, height)
    gaussians = cull_far_shell(gaussians, T_world_camera[:3, 3])
    if state.as_points:
        return paint_points(gaussians, np.linalg.inv(T_world_camera), K, state.point_size, width, height)
    rendered = render_arrays(
        gaussians, T_world_camera.astype(np.float64), K.astype(np.float64), width, height, channels=("rgb", "depth")
    )
    planes = [  # 255 * rgb + (1 - alpha) * background, rounded and clipped
        cv2.addWeighted(rendered.rgb[..., channel], 255.0, rendered.alpha, -level, level, dtype=cv2.CV_8U)
        for channel, level in enumerate(BACKGROUND)
    ]
    np.copyto(rendered.depth, np.inf, where=rendered.alpha <= 0.5)
    return Canvas(np.asarray(cv2.merge(planes), np.uint8), rendered.depth)


def paint_coarsely(
    gaussians: GaussianArrays, view: Viewpoint, state: ViewerState, size: tuple[int, int], part: int
) -> Canvas:
    """The Gaussians for a picture of this size (width, height), painted with one `part`-th of it and made larger."""
    width, height = size
    small = -(-width // part), -(-height // part)
    K = np.diag([small[0] / width, small[1] / height, 1.0]) @ view.K(width, height)
    points = max(1, round(state.point_size / part))
    canvas = paint_gaussians(gaussians, view.T_world_camera, K, replace(state, point_size=points), *small)
    if part == 1:
        return canvas
    image = np.asarray(cv2.resize(canvas.image, size, interpolation=cv2.INTER_LINEAR), np.uint8)
    depth = np.asarray(cv2.resize(canvas.depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
    return Canvas(image, depth)


def blend_image(image: Image, photograph: Image, camera: CameraEstimate, K: FloatArray, weight: float) -> Image:
    """`image` with the camera's photograph over it, where both are seen from the camera and `K` is the window's."""
    height, width = image.shape[:2]
    size = np.array([camera.width / photograph.shape[1], camera.height / photograph.shape[0], 1.0])
    homography = K @ np.linalg.inv(camera.K) @ np.diag(size)
    corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV's top-left pixel has its centre at (0, 0)
    homography = np.linalg.inv(corner) @ homography @ corner
    over = cv2.warpPerspective(photograph, homography, (width, height), borderMode=cv2.BORDER_REPLICATE)
    inside = cv2.warpPerspective(np.full(photograph.shape[:2], 255, np.uint8), homography, (width, height))
    share = (weight / 255.0 * inside).astype(np.float32)
    return np.asarray(cv2.blendLinear(over, image, share, 1.0 - share), np.uint8)


def add_caption(image: Image, lines: Sequence[str]) -> Image:
    """The image with text on a dark band below it, wrapped; signs that OpenCV's font lacks become plain ones."""
    step, letters = 18, max((image.shape[1] - 16) // _LETTER, 10)
    plain = [line.replace("°", " deg").replace("×", "x").encode("ascii", "replace").decode() for line in lines]
    wrapped = [part for line in plain for part in textwrap.wrap(line, letters)]
    band = np.full((step * len(wrapped) + 10, image.shape[1], 3), BACKGROUND, np.uint8)
    for row, line in enumerate(wrapped):
        origin = (8, step * (row + 1) - 2)
        cv2.putText(band, line, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (225, 225, 225), 1, cv2.LINE_AA)
    return np.vstack([image, band])


# How coarse a picture is painted while the person drags.

SLOWEST_S = (
    0.05  # a picture while dragging may take: twice that, with what else a window does, are 10 pictures a second
)
_COARSEST = 4


def choose_first_divisor(seconds: float) -> int:
    """Returns the divisor of width and height with which a picture of `seconds` in full takes SLOWEST_S at most."""
    return min(max(math.ceil(math.sqrt(seconds / SLOWEST_S) - 0.1), 1), _COARSEST)


def choose_next_divisor(part: int, seconds: float) -> int:
    """The divisor after a picture with this one took `seconds`: coarser where it was late, finer where time is left."""
    if seconds > SLOWEST_S:
        return min(part + 1, _COARSEST)
    finer = max(part - 1, 1)
    return finer if seconds * (part / finer) ** 2 < 0.8 * SLOWEST_S else part
