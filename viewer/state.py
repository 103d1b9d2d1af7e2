"""What the viewer shows and how: a value that keys and buttons turn into another value."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import Selection
from splatnode.recon.result.snapshot import Snapshot

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
