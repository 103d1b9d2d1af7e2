"""What the viewer shows, how, and from where: values that keys and buttons turn into other values."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import Selection
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot

# What the viewer shows and how: a value that keys and buttons turn into another value.

# A map as a graph: its scenes, how they are linked, and how much of each is loaded. Its lines and its words.

Array = npt.NDArray[np.float64]

FULL = 0  # the level of a scene that is shown as it is; 1, 2 ... are coarser
NOTHING = -1  # of a scene that is not loaded

_MOST_PLACES = 14  # that the panel lists
_MOST_LINKS = 8  # loops, and what was retracted
_DASHES = 9  # of a line that no longer counts
_MARK = 0.015  # half the size of a scene's mark, in parts of the scene's depth, which is about 1


@dataclass(frozen=True, eq=False)
class GraphNode:
    """A scene of the map, or a place that is in no map: that has no centre."""

    scene_id: str
    verdict: str
    good: bool  # whether its scene is shown
    centre: Array | None  # (3,) the middle of its cameras
    num_gaussians: int  # that are loaded
    level: int  # FULL, coarser, or NOTHING


@dataclass(frozen=True, eq=False)
class GraphEdge:
    """A link between two scenes of the map."""

    scene: str
    other: str
    ends: Array  # (2, 3) the middles of the cameras
    loop: bool  # the place was found again
    retracted: str | None  # why the link no longer counts; None: it does


@dataclass(frozen=True, eq=False)
class Graph:
    nodes: tuple[GraphNode, ...]  # the nearest first
    edges: tuple[GraphEdge, ...]
    which: int  # the map's number, from 0 on
    maps: int  # how many there are
    merged: bool  # whether what is shown was merged


def edge_lines(edges: tuple[GraphEdge, ...], *, loop: bool, retracted: bool) -> Array:
    """(M, 2, 3) the lines of one kind of links: whole, or dashed where they no longer count."""
    ends = [edge.ends for edge in edges if edge.loop is loop and (edge.retracted is not None) is retracted]
    whole = np.array(ends, np.float64).reshape(-1, 2, 3)
    return _dash_lines(whole) if retracted else whole


def node_marks(nodes: tuple[GraphNode, ...], *, good: bool) -> Array:
    """(M, 2, 3) an octahedron around the middle of each scene of one kind that has one."""
    centres = np.array([node.centre for node in nodes if node.centre is not None and node.good is good])
    tips = _MARK * np.concatenate([np.eye(3), -np.eye(3)])
    pairs = [(a, b) for a in range(6) for b in range(a + 1, 6) if b != a + 3]
    edges = np.array([[tips[a], tips[b]] for a, b in pairs])
    return (centres.reshape(-1, 1, 1, 3) + edges[None]).reshape(-1, 2, 3)


def place_lines(graph: Graph) -> list[str]:
    """The places with what was found of each and how much of it is loaded, and the links that are no mere chain."""
    title = f"map {graph.which + 1} of {graph.maps} (m: the next)" if graph.maps > 1 else "one map"
    seams = "merged" if graph.merged else "not merged: splatnode merge makes clean seams"
    lines = [f"{title}, {seams}"]
    lines += [f"{node.scene_id} {node.verdict}: {_detail(node)}" for node in graph.nodes[:_MOST_PLACES]]
    further = len(graph.nodes) - _MOST_PLACES
    lines += [f"and {further} further away"] * (further > 0)
    special = [edge for edge in graph.edges if edge.loop or edge.retracted is not None]
    for edge in special[:_MOST_LINKS]:
        kind = "loop" if edge.loop else "chain"
        why = f", taken back: {edge.retracted}" if edge.retracted is not None else ""
        lines.append(f"{kind} {edge.scene} to {edge.other}{why}")
    return lines


def _detail(node: GraphNode) -> str:
    if node.level == NOTHING:
        return "not loaded" if node.good else "no scene"
    how = "full detail" if node.level == FULL else f"coarse, level {node.level}"
    return f"{node.num_gaussians} Gaussians, {how}"


def _dash_lines(lines: Array) -> Array:
    """Every other part of the lines (M, 2, 3)."""
    at = np.linspace(0.0, 1.0, 2 * _DASHES)
    start, step = lines[:, :1], lines[:, 1:] - lines[:, :1]
    points = start + at[None, :, None] * step  # (M, 2 dashes, 3)
    return points.reshape(-1, 2, 3)


# Moments: snapshots as they reached the viewer, and the bounded history of them that the time slider goes through.

MEMORY_BYTES = 256_000_000  # of a history: some fifty moments of 30 000 Gaussians and 12 cameras
_SMALLEST = 16  # pixels: a photograph that is drawn smaller is a spot


@dataclass(frozen=True, eq=False)
class Moment:
    """A snapshot as it reached the viewer. Its `images` may be of any size, and may lack some cameras."""

    snapshot: Snapshot
    received_s: float  # monotonic clock of the viewer
    scene_id: str = ""  # another one is another place: a viewpoint does not carry over
    graph: Graph | None = None  # of a map of several scenes, of which this is what is loaded; None: of one scene

    @cached_property
    def photographs(self) -> dict[str, tuple[npt.NDArray[np.uint8], ...]]:
        """The images at their size, at half of it, at a quarter and so on: what is drawn small must not flicker."""
        return {name: _build_image_pyramid(image) for name, image in self.snapshot.images.items()}

    @property
    def num_bytes(self) -> int:
        gaussians = self.snapshot.gaussians
        arrays = sum(getattr(gaussians, field.name).nbytes for field in fields(gaussians))
        return arrays + sum(4 * image.nbytes // 3 for image in self.snapshot.images.values())  # with `photographs`


History = tuple[Moment, ...]  # oldest first

_MOST_MOVED = 0.5  # of the spread of the cameras, by which those of a scene that grows may move from moment to moment


def same_world(one: Moment, other: Moment) -> bool:
    """Whether a point of one is at the same place in the other: in one scene and unit, with cameras where they were.

    A scene comes into another world when metres, or poses that were given, become known.
    """
    if one.scene_id != other.scene_id or one.snapshot.scale.metric != other.snapshot.scale.metric:
        return False
    if one.graph is not None:
        return True  # a map stays where it is
    known = {camera.name: camera.T_world_camera[:3, 3] for camera in other.snapshot.cameras}
    both = [
        (camera.T_world_camera[:3, 3], known[camera.name]) for camera in one.snapshot.cameras if camera.name in known
    ]
    if len(both) < 2:
        return True
    here, there = np.array(both).swapaxes(0, 1)
    spread = max(float(np.linalg.norm(each.std(axis=0))) for each in (here, there))  # RMS distance from their mean
    return bool(np.linalg.norm(here - there, axis=1).max() <= _MOST_MOVED * spread)


def append_moment(history: History, moment: Moment, memory_bytes: int = MEMORY_BYTES) -> History:
    """The history with `moment` as its newest, thinned until it fits into `memory_bytes`.

    What goes first is the moment whose neighbours are closest together in time, so that the whole time axis stays
    covered. The first and the newest moment always stay. Of a map only the newest does: the others had parts of it.
    """
    if moment.graph is not None:
        return (moment,)
    kept = [*history, moment]
    while len(kept) > 2 and sum(one.num_bytes for one in kept) > memory_bytes:
        gaps = [after.received_s - before.received_s for before, after in zip(kept, kept[2:], strict=False)]
        del kept[1 + int(np.argmin(gaps))]
    return tuple(kept)


def _build_image_pyramid(image: npt.NDArray[np.uint8]) -> tuple[npt.NDArray[np.uint8], ...]:
    levels = [image]
    while min(levels[-1].shape[:2]) >= 2 * _SMALLEST:
        height, width = levels[-1].shape[:2]
        levels.append(
            np.asarray(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)
        )
    return tuple(levels)


POINT_SIZES = (1, 12)  # pixels
BLEND_STEP = 0.25
Span = tuple[float, float]  # where a side of the box to crop with begins and ends, 0 to 1 of the room
WHOLE_ROOM: tuple[Span, Span, Span] = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))


class Engine(enum.Enum):
    """Who draws the Gaussians: the project's own rasteriser on the processor, or Open3D through Vulkan."""

    CORE = "splatnode's own rasteriser"
    OPEN3D = "Open3D's renderer"


class Colouring(enum.Enum):
    PHOTOGRAPH = "as photographed"
    DEPTH = "depth (red is near)"
    NORMAL = "normal"
    SUPPORT = "supporting views (red: one, green: four or more)"
    SOURCE = "source frame"


@dataclass(frozen=True, eq=False)
class ViewerState:
    engine: Engine = Engine.CORE
    as_points: bool = False
    point_size: int = 3  # pixels
    colouring: Colouring = Colouring.PHOTOGRAPH
    gaussians: bool = True
    cameras: bool = True
    photographs: bool = True
    path: bool = True
    tracked: bool = True
    advice: bool = True
    uncertainty: bool = True
    graph: bool = True
    ground: bool = True  # with the axes and the legend
    given: bool = True  # poses that others gave, beside the estimated ones
    which_map: int = 0  # of a folder with several
    help: bool = False
    paused: bool = False
    follow: bool = False  # the viewpoint is that of the live camera
    camera: str | None = None  # the viewpoint is that of this camera
    blend: float = 0.0  # how much of its photograph lies over the render there, 0 to 1
    held: Moment | None = None  # a moment of the past; None: the newest
    measuring: bool = False  # a click on the scene sets a point to measure from or to
    measured: tuple[npt.NDArray[np.float64], ...] = ()  # at most two points (3,)
    boxed: bool = False  # the box to crop with is shown
    box: tuple[Span, Span, Span] = WHOLE_ROOM  # along the world's x, y and z
    edits: tuple[Selection, ...] = ()  # what was taken out of the scene, in order


Change = Callable[[ViewerState, History], ViewerState]


@dataclass(frozen=True)
class Binding:
    key: str  # a character, or the name of a key
    help: str
    change: Change


def open3d_draws(state: ViewerState, software: bool) -> bool:
    """Whether Open3D is asked for the picture, and for one that it draws whole.

    Its splat shader leaves tiles black, mostly whole rows of them, where Vulkan is `software` (Open3D 0.20, Mesa 22.3).
    """
    return state.engine is Engine.OPEN3D and (state.as_points or not software)


def current_moment(state: ViewerState, history: History) -> Moment | None:
    """The moment to show, None where nothing has come yet."""
    if state.held is not None:
        return state.held
    return history[-1] if history else None


def press(state: ViewerState, history: History, key: str) -> ViewerState:
    """The state after a key; keys that mean nothing leave it as it is."""
    for binding in BINDINGS:
        if binding.key == key:
            return binding.change(state, history)
    return state


def go_to_camera(state: ViewerState, name: str | None) -> ViewerState:
    """The viewpoint of the camera called `name`; None leaves the cameras."""
    return replace(state, camera=name, follow=False)


def go_to_moment(state: ViewerState, history: History, index: int) -> ViewerState:
    """The moment at `index` of the history; the last one means the newest, also when newer ones come."""
    if not history or (index >= len(history) - 1 and not state.paused):
        return replace(state, held=None)
    return replace(state, held=history[min(max(index, 0), len(history) - 1)])


def moment_index(state: ViewerState, history: History) -> int:
    """Returns the index of the current moment on the time axis. One that was thinned out is where it would be."""
    if state.held is None:
        return max(len(history) - 1, 0)
    later = [index for index, moment in enumerate(history) if moment.received_s >= state.held.received_s]
    return later[0] if later else max(len(history) - 1, 0)


def _toggle(field: str) -> Change:
    return lambda state, _history: replace(state, **{field: not getattr(state, field)})


def _pause(state: ViewerState, history: History) -> ViewerState:
    """Stops at what is shown; goes on with the newest."""
    if state.paused:
        return replace(state, paused=False, held=None)
    return replace(state, paused=True, held=current_moment(state, history))


def _follow(state: ViewerState, _history: History) -> ViewerState:
    return replace(state, follow=not state.follow, camera=None)


def _measure(state: ViewerState, _history: History) -> ViewerState:
    """Begins to measure; ends it, and forgets the points."""
    return replace(state, measuring=not state.measuring, measured=())


def _undo(state: ViewerState, _history: History) -> ViewerState:
    return replace(state, edits=state.edits[:-1])


def _engine(state: ViewerState, _history: History) -> ViewerState:
    return replace(state, engine=Engine.OPEN3D if state.engine is Engine.CORE else Engine.CORE)


def _colouring(state: ViewerState, _history: History) -> ViewerState:
    order = list(Colouring)
    return replace(state, colouring=order[(order.index(state.colouring) + 1) % len(order)])


def _resize(step: int) -> Change:
    smallest, largest = POINT_SIZES
    return lambda state, _history: replace(state, point_size=min(max(state.point_size + step, smallest), largest))


def _blend(step: float) -> Change:
    return lambda state, _history: replace(state, blend=min(max(state.blend + step, 0.0), 1.0))


def _camera(step: int) -> Change:
    def change(state: ViewerState, history: History) -> ViewerState:
        moment = current_moment(state, history)
        names = [camera.name for camera in moment.snapshot.cameras] if moment else []
        if not names:
            return state
        if state.camera not in names:
            return go_to_camera(state, names[0 if step > 0 else -1])
        return go_to_camera(state, names[(names.index(state.camera) + step) % len(names)])

    return change


def _time(step: int) -> Change:
    return lambda state, history: go_to_moment(state, history, moment_index(state, history) + step)


def _next_map(state: ViewerState, _history: History) -> ViewerState:
    return replace(state, which_map=state.which_map + 1, camera=None, follow=False, held=None, paused=False)


def _leave(state: ViewerState, _history: History) -> ViewerState:
    return replace(state, camera=None, follow=False, help=False)


BINDINGS = (
    Binding("h", "show or hide this help", _toggle("help")),
    Binding("g", "Gaussians as Gaussians or as points", _toggle("as_points")),
    Binding("e", "drawn by splatnode or by Open3D", _engine),
    Binding("c", "next colouring", _colouring),
    Binding("[", "smaller points", _resize(-1)),
    Binding("]", "larger points", _resize(1)),
    Binding("1", "show or hide the Gaussians", _toggle("gaussians")),
    Binding("2", "show or hide the cameras", _toggle("cameras")),
    Binding("3", "show or hide the photographs on them", _toggle("photographs")),
    Binding("4", "show or hide the path", _toggle("path")),
    Binding("5", "show or hide the tracked camera", _toggle("tracked")),
    Binding("6", "show or hide the advice for the next view", _toggle("advice")),
    Binding("7", "show or hide where the cameras may be, with 95 %", _toggle("uncertainty")),
    Binding("8", "show or hide the graph of a map's scenes", _toggle("graph")),
    Binding("9", "show or hide the ground, the axes and the scale bar", _toggle("ground")),
    Binding("0", "show or hide the poses that were given", _toggle("given")),
    Binding("d", "measure: the distance between two clicks", _measure),
    Binding("b", "show or hide the box to crop with", _toggle("boxed")),
    Binding("z", "undo the last crop or clean-up", _undo),
    Binding("m", "the next map, where there are several", _next_map),
    Binding("n", "go to the next camera", _camera(1)),
    Binding("p", "go to the previous camera", _camera(-1)),
    Binding(".", "more of its photograph over the render", _blend(BLEND_STEP)),
    Binding(",", "less of it", _blend(-BLEND_STEP)),
    Binding("f", "follow the live camera", _follow),
    Binding("space", "pause: keep what is shown", _pause),
    Binding("left", "back in time", _time(-1)),
    Binding("right", "forward in time", _time(1)),
    Binding("x", "leave a camera, close the help", _leave),
)

COMMANDS = {
    "r": "look at the whole scene",
    "k": "keep only what is in the box",
    "o": "keep only what two photographs confirm",
    "w": "save what is left as a new result",
    "s": "save a screenshot",
    "q": "close the viewer",
}

MOUSE = (
    ("left button", "orbit; a click on a camera goes there, or measures (d)"),
    ("right button", "pan"),
    ("wheel", "zoom"),
)


def help_lines() -> list[tuple[str, str]]:
    """Lists the commands: key or mouse, and what it does."""
    return [*MOUSE, *((binding.key, binding.help) for binding in BINDINGS), *COMMANDS.items()]


# Where the person looks from: orbit, pan, zoom, and the viewpoints that a scene suggests. Pure functions.

_STEEPEST = math.radians(85.0)  # of a viewing direction, from the horizontal
_SLANT = math.radians(50.0)  # at which a map is looked down on
_NEAREST = 1e-3  # world units, of the pivot
_SHALLOWEST = 0.1  # world units, of the pivot that a camera's viewpoint is given
_LENS = np.array([[0.9, 0.0, 0.5], [0.0, 0.9, 0.375], [0.0, 0.0, 1.0]]), 1.0, 0.75  # where no camera suggests one


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera that the person moves. The pivot is `distance` ahead of it; orbits go around it."""

    T_world_camera: Array  # (4, 4)
    distance: float
    up: Array  # (3,) unit, the world's
    lens: tuple[Array, float, float]  # K (3, 3), width, height: what has to fit into the window

    @property
    def pivot(self) -> Array:
        return self.T_world_camera[:3, 3] + self.distance * self.T_world_camera[:3, 2]

    def K(self, width: int, height: int) -> Array:
        """(3, 3) for a window in which the lens's image lies in the middle, as large as it fits."""
        K, lens_width, lens_height = self.lens
        scale = min(width / lens_width, height / lens_height)
        margin = np.array([width - scale * lens_width, height - scale * lens_height]) / 2.0
        fitted = K.copy()
        fitted[:2] *= scale
        fitted[:2, 2] += margin
        return fitted


def look_at(centre: Array, target: Array, up: Array) -> Array:
    """(4, 4) T_world_camera at `centre` that looks at `target`, with `up` pointing up in the image."""
    forward = (target - centre) / max(float(np.linalg.norm(target - centre)), 1e-12)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:  # straight up or down: any direction to the right will do
        right = np.cross(forward, np.roll(up, 1))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3] = np.column_stack([right, np.cross(forward, right), forward, centre])
    return T


def orbit(view: Viewpoint, right_rad: float, up_rad: float) -> Viewpoint:
    """After a walk around the pivot: to the right around the world's up, then upwards, not over the pole."""
    outwards = (view.T_world_camera[:3, 3] - view.pivot) / view.distance
    elevation = math.asin(float(np.clip(outwards @ view.up, -1.0, 1.0)))
    raised = float(np.clip(elevation + up_rad, -_STEEPEST, _STEEPEST)) if abs(elevation) < _STEEPEST else elevation
    turned = _rotation(view.up, right_rad) @ outwards
    flat = turned - (turned @ view.up) * view.up
    flat /= max(float(np.linalg.norm(flat)), 1e-12)
    direction = math.cos(raised) * flat + math.sin(raised) * view.up
    return replace(view, T_world_camera=look_at(view.pivot + view.distance * direction, view.pivot, view.up))


def pan(view: Viewpoint, right_px: float, down_px: float, focal_px: float) -> Viewpoint:
    """After a drag of the scene by pixels: what is at the pivot's distance stays under the pointer."""
    T = view.T_world_camera.copy()
    T[:3, 3] -= view.distance / focal_px * (right_px * T[:3, 0] + down_px * T[:3, 1])
    return replace(view, T_world_camera=T)


def zoom(view: Viewpoint, factor: float) -> Viewpoint:
    """Returns the view with its distance to the pivot multiplied by `factor`."""
    distance = max(view.distance * factor, _NEAREST)
    T = view.T_world_camera.copy()
    T[:3, 3] = view.pivot - distance * T[:3, 2]
    return replace(view, T_world_camera=T, distance=distance)


def move_to_camera(view: Viewpoint, camera: CameraEstimate) -> Viewpoint:
    """The viewpoint of an estimated camera, with its lens."""
    lens = camera.K, float(camera.width), float(camera.height)
    return replace(view, T_world_camera=camera.T_world_camera, lens=lens)


def set_pivot_depth(view: Viewpoint, pivot: Array) -> Viewpoint:
    """The same picture, with the point that orbits go around as deep as the `pivot` (3,)."""
    depth = float((pivot - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, 2])
    return replace(view, distance=max(depth, _SHALLOWEST))


def first_view(moment: Moment) -> Viewpoint:
    """From the camera in the middle of the others, which saw what is shown; of a map, or without cameras, outside."""
    view, cameras = overview(moment), moment.snapshot.cameras
    if moment.graph is not None or not cameras:
        return view
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    middle = cameras[int(np.linalg.norm(centres - centres.mean(0), axis=1).argmin())]
    return set_pivot_depth(move_to_camera(view, middle), scene_pivot(moment))


def overview(moment: Moment, also: Sequence[Array] = ()) -> Viewpoint:
    """From behind and above the cameras, at the middle of what they see; the points (3,) `also` are in the picture."""
    cameras = moment.snapshot.cameras
    if moment.graph is not None and cameras:
        return _map_overview(cameras)
    up, pivot = scene_up(cameras), scene_pivot(moment)
    if not cameras:
        spread = scene_spread(moment, pivot)
        centre = pivot - np.array([0.0, 0.0, 2.5 * spread]) + 0.5 * spread * up
        return Viewpoint(look_at(centre, pivot, up), float(np.linalg.norm(centre - pivot)), up, _LENS)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    backwards = centres.mean(0) - pivot
    middle = cameras[len(cameras) // 2]
    lens = middle.K, float(middle.width), float(middle.height)
    slope = np.array([middle.width, middle.height]) / (2.0 * middle.K[[0, 1], [0, 1]])
    seen = np.array([*centres, *also])
    for factor in np.arange(1.3, 4.0, 0.15):  # as close as it can be with every camera in the picture
        centre = pivot + factor * (backwards + 0.25 * float(np.linalg.norm(backwards)) * up)
        view = Viewpoint(look_at(centre, pivot, up), float(np.linalg.norm(centre - pivot)), up, lens)
        local = (seen - centre) @ view.T_world_camera[:3, :3]
        if (np.abs(local[:, :2]) < 0.93 * slope * local[:, 2:]).all():
            break
    return view


def _map_overview(cameras: tuple[CameraEstimate, ...]) -> Viewpoint:
    """From above at a slant, along the shorter side of where the cameras were, with all of them in the picture."""
    up = scene_up(cameras)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    pivot = (centres.max(0) + centres.min(0)) / 2.0
    flat = (centres - centres.mean(0)) @ (np.eye(3) - np.outer(up, up))
    shorter = np.cross(up, np.linalg.svd(flat, full_matrices=False)[2][0])
    length = float(np.linalg.norm(shorter))
    away = shorter / length if length > 1e-6 else -cameras[0].T_world_camera[:3, 2]
    reach = max(float(np.linalg.norm(centres - pivot, axis=1).max()), 0.5)
    middle = cameras[len(cameras) // 2]
    lens = middle.K, float(middle.width), float(middle.height)
    slope = min(middle.width / middle.K[0, 0], middle.height / middle.K[1, 1]) / 2.0
    distance = reach * math.hypot(1.0, 1.0 / slope)
    centre = pivot + distance * (math.sin(_SLANT) * up + math.cos(_SLANT) * away)
    return Viewpoint(look_at(centre, pivot, up), distance, up, lens)


def scene_up(cameras: tuple[CameraEstimate, ...]) -> Array:
    """(3,) people hold cameras upright: the mean of their upward axes; the first camera's where there are none."""
    if not cameras:
        return np.array([0.0, -1.0, 0.0])
    total = np.sum([-camera.T_world_camera[:3, 1] for camera in cameras], axis=0)
    length = float(np.linalg.norm(total))
    return total / length if length > 1e-6 else -cameras[0].T_world_camera[:3, 1]


def scene_pivot(moment: Moment) -> Array:
    """(3,) the middle of what the cameras see: ahead of their middle, at the median depth of the Gaussians."""
    cameras, means = moment.snapshot.cameras, moment.snapshot.gaussians.means
    if not cameras:
        return np.median(means, axis=0).astype(np.float64) if len(means) else np.array([0.0, 0.0, 1.0])
    centre = np.mean([camera.T_world_camera[:3, 3] for camera in cameras], axis=0)
    forward = np.sum([camera.T_world_camera[:3, 2] for camera in cameras], axis=0)
    if np.linalg.norm(forward) < 0.3 * len(cameras):  # cameras all around: they look inwards or outwards
        return np.median(means, axis=0).astype(np.float64) if len(means) else centre
    forward /= np.linalg.norm(forward)
    depths = (means - centre) @ forward
    ahead = depths[depths > 0]
    return centre + (float(np.median(ahead)) if len(ahead) else 1.0) * forward


@lru_cache(maxsize=1)  # of the moment that is shown: all its pictures ask for it
def scene_depth(moment: Moment) -> float:
    """How far what the cameras see is from their middle; 1, which it is about, where lengths are no metres."""
    cameras = moment.snapshot.cameras
    if not moment.snapshot.scale.metric or not cameras:
        return 1.0
    middle = np.mean([camera.T_world_camera[:3, 3] for camera in cameras], axis=0)
    return float(np.linalg.norm(scene_pivot(moment) - middle)) or 1.0


def scene_spread(moment: Moment, pivot: Array) -> float:
    """The median distance of the Gaussians from the pivot; 1 where there are none."""
    means = moment.snapshot.gaussians.means
    return float(np.median(np.linalg.norm(means - pivot, axis=1))) or 1.0 if len(means) else 1.0


def _rotation(axis: Array, angle: float) -> Array:
    """(3, 3) rotation by Rodrigues' formula; `axis` is a unit vector."""
    cross = np.cross(np.eye(3), axis)  # cross @ v is axis x v
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


# The picture that is being painted: colours, and how far what they show is away.

FloatArray = npt.NDArray[np.floating]
Image = npt.NDArray[np.uint8]  # (H, W, 3) RGB

BACKGROUND = (24, 26, 30)
NEAR = 0.005  # world units: nothing closer is drawn


@dataclass(frozen=True, eq=False)
class Canvas:
    image: Image
    depth: npt.NDArray[np.float32]  # (H, W) z of what is there, infinite where there is nothing


def empty_canvas(width: int, height: int) -> Canvas:
    return Canvas(np.full((height, width, 3), BACKGROUND, np.uint8), np.full((height, width), np.inf, np.float32))


def project(points: FloatArray, view: Viewpoint, width: int, height: int) -> FloatArray:
    """(M, 3) pixel x, pixel y and z of world points (M, 3) in the window."""
    local = transform_to_camera(points, np.linalg.inv(view.T_world_camera))
    z = np.where(np.abs(local[:, 2]) > 1e-9, local[:, 2], 1e-9)
    homogeneous = local @ view.K(width, height).T
    return np.column_stack([homogeneous[:, :2] / z[:, None], local[:, 2]])


def transform_to_camera(points: FloatArray, T_camera_world: FloatArray) -> FloatArray:
    """(..., 3) world points in the camera's frame."""
    return points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
