"""What stands in the scene beside the Gaussians: frusta, photographs, where cameras may be, the path, the next view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.viewer.advice import Advice
from splatnode.viewer.colours import source_colour
from splatnode.viewer.graph import Graph, edge_lines, node_marks
from splatnode.viewer.moment import Moment
from splatnode.viewer.state import ViewerState
from splatnode.viewer.viewpoint import look_at, scene_depth, scene_up

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
    lines, photographs, labels = [], [], []
    if state.path and len(snapshot.cameras) > 1:
        lines.append(Lines(path(snapshot.cameras), PATH_COLOUR, 1))
    if state.cameras:
        for index, camera in others:
            corners = image_corners(camera, camera.T_world_camera, depth)
            lines.append(Lines(frustum(camera.T_world_camera, corners), source_colour(index), 2))
            if state.photographs and camera.name in moment.photographs:
                photographs.append(ImageQuad(camera.name, corners, moment.photographs[camera.name]))
    if state.graph and moment.graph is not None:
        lines += _graph(moment.graph)
    if state.uncertainty:
        for index, camera, axes in _select_uncertain_cameras(snapshot.cameras, eye):
            lines.append(Lines(ellipsoid(camera, axes), source_colour(index), 1))
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
