"""What a viewer goes through, whatever shows it: moments come, keys are pressed, viewpoints move, scenes are cut."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export import SceneFileError, sanitize_gaussians, write_files
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.limits import Box, Selection
from splatnode.recon.result.export.stored import SOURCES, encode_cameras, encode_sources
from splatnode.recon.result.snapshot import (
    SHELL,
    CameraEstimate,
    GaussianArrays,
    find_confirmed,
    format_camera_bounds,
    format_widest_bounds,
)
from splatnode.recon.result.stored_snapshot import format_percent
from splatnode.viewer.analysis import Advice, Analysis, Analyst, Support, colour_gaussians
from splatnode.viewer.shapes import (
    Colour,
    Ground,
    ImageQuad,
    Lines,
    Shapes,
    add_point,
    blend_image,
    format_length,
    ground,
    ground_lines,
    legend,
    live_camera,
    measurement_shapes,
    merge_shapes,
    overlay_shapes,
    paint_coarsely,
    shapes,
    surface_point,
)
from splatnode.viewer.sources import PagedSource, Source
from splatnode.viewer.state import (
    MEMORY_BYTES,
    Canvas,
    Colouring,
    History,
    Image,
    Moment,
    Span,
    ViewerState,
    Viewpoint,
    append_moment,
    current_moment,
    first_view,
    go_to_camera,
    moment_index,
    move_to_camera,
    overview,
    press,
    project,
    same_world,
    scene_pivot,
    scene_spread,
    set_pivot_depth,
)
from splatnode.viewer.state import place_lines as graph_lines

# Crop and clean-up: what is taken out of the scene that is shown, step by step, and the new result that is written.
#
# The file that was opened, and the scene of the node, stay as they are.

Edits = tuple[Selection, ...]  # in the order in which they were made; undo takes the last one away

BOX_COLOUR: Colour = (1.0, 0.6, 0.9)
_AROUND = 3.0  # times the median distance from the middle: what is farther does not widen the room
_WITHIN = (0.5, 99.5)  # percent of the Gaussians, on each axis
_WIDER = 0.05  # of the room, on each side
_SMALLEST = 1e-5  # of how far it is away, a room
_THINNEST = 0.01  # of the room, a box


class EditError(Exception):
    """An edit cannot be applied; the message says why."""


def apply_edits(gaussians: GaussianArrays, edits: Edits) -> GaussianArrays:
    """Returns the Gaussians that the edits leave, or none where one of the edits leaves nothing."""
    try:
        for edit in edits:
            gaussians = edit.apply(gaussians, "the scene")
    except SceneFileError:  # a scene that changed since: what was asked for is not in it any more
        return GaussianArrays.empty()
    return gaussians


def add_edit(moment: Moment, edits: Edits, edit: Selection) -> Edits:
    """The edits with another one. Raises EditError where it cannot be told what it leaves, or where that is nothing."""
    if moment.graph is not None:
        raise EditError("A map shows only what is near: cut a single scene, or use splatnode export --crop.")
    before = apply_edits(moment.snapshot.gaussians, edits)
    if edit.only_seen and not (before.source_frame != SHELL).any():
        raise EditError(
            f"This file does not tell which Gaussians two photographs confirm: that is in the {SOURCES} of a result."
        )
    try:
        after = edit.apply(before, "the scene")
    except SceneFileError:
        raise EditError("Nothing would be left: nothing was changed.") from None
    if len(after) == len(before):
        raise EditError("There was nothing to take away.")
    return (*edits, edit)


def compute_crop_bounds(moment: Moment) -> npt.NDArray[np.float64]:
    """(2, 3) the least and the greatest corner of the room that boxes are cut from: around what was photographed.

    That is what two photographs confirm, where it is known; without the far and a few in a hundred in any case.
    """
    gaussians = moment.snapshot.gaussians
    confirmed = find_confirmed(gaussians.source_frame)
    means = (gaussians.means[confirmed] if confirmed.any() else gaussians.means).astype(np.float64)
    if not len(means):
        return np.array([[-1.0] * 3, [1.0] * 3])
    pivot = scene_pivot(moment)
    near = means[np.linalg.norm(means - pivot, axis=1) <= _AROUND * scene_spread(moment, pivot)]
    least, most = np.percentile(near if len(near) else means, _WITHIN, axis=0)
    wider = _WIDER * np.maximum(most - least, _SMALLEST * (1.0 + np.abs(most)))
    return np.array([least - wider, most + wider])


def box(corners: npt.NDArray[np.float64], spans: tuple[Span, Span, Span]) -> Box:
    """The box that the spans cut from a room (2, 3)."""
    least, size = corners[0], corners[1] - corners[0]
    sides = [
        (float(start + length * low), float(start + length * max(high, low + _THINNEST)))
        for start, length, (low, high) in zip(least, size, spans, strict=True)
    ]
    (x0, x1), (y0, y1), (z0, z1) = sides
    return Box((x0, y0, z0), (x1, y1, z1))


def box_lines(cut: Box) -> Lines:
    """Its twelve edges."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    at = np.where(corners == 0, np.array(cut.least), np.array(cut.most))
    ends = [(at[a], at[b]) for a in range(8) for b in range(a + 1, 8) if np.abs(corners[a] - corners[b]).sum() == 1]
    return Lines(np.array(ends), BOX_COLOUR, 2)


def edit_lines(moment: Moment, edits: Edits) -> list[str]:
    """Describes how many Gaussians the edits leave."""
    if not edits:
        return ["Nothing is taken away yet."]
    whole, left = len(moment.snapshot.gaussians), len(apply_edits(moment.snapshot.gaussians, edits))
    return [f"{left} of {whole} Gaussians left ({len(edits)} step{'s' * (len(edits) != 1)})."]


def write_edited(moment: Moment, edits: Edits, folder: Path) -> Path:
    """Writes what is left as a new result in a new folder of `folder`, which it returns; nothing is overwritten.

    Raises EditError where nothing was taken away or nothing is left, ResultWriteError.
    """
    if not edits:
        raise EditError("Nothing was taken away: there is nothing new to save.")
    snapshot = moment.snapshot
    left = sanitize_gaussians(apply_edits(snapshot.gaussians, edits))
    if not len(left):
        raise EditError("Nothing is left: there is nothing to save.")
    files = {"scene.ply": encode_ply(left, snapshot.scale)}
    if snapshot.cameras:
        files["cameras.json"] = encode_cameras(snapshot.cameras, snapshot.scale)
    if (left.source_frame != SHELL).any():
        files[SOURCES] = encode_sources(left.source_frame)
    new = _new_folder(folder)
    write_files(new, files)
    return new


def _new_folder(folder: Path) -> Path:
    """A name that nothing has yet."""
    stem = time.strftime("edited_%Y%m%d_%H%M%S")
    names = [stem, *(f"{stem}_{number}" for number in range(2, 1000))]
    return next(folder / name for name in names if not (folder / name).exists())


# What a viewer goes through, whatever shows it: moments come, keys are pressed, the viewpoint moves.

_CLICK_RADIUS = 14  # pixels around a camera's centre that are the camera


class Session:
    """The history, the state and the viewpoint, and the pictures that follow from them. To be used in one thread."""

    def __init__(self, source: Source, state: ViewerState, memory_bytes: int = MEMORY_BYTES) -> None:
        self.source = source
        self._memory_bytes = memory_bytes  # of the history
        self.state = state
        self.history: History = ()
        self._analyst = Analyst()
        self._analysis: Analysis | None = None
        self._view: Viewpoint | None = None
        self._tracked: CameraEstimate | None = None  # the live camera
        self._touched = False  # whether the person has chosen a viewpoint
        self._from_outside = False  # whether the person has asked to see the whole scene
        self._world: Moment | None = None  # shown last: the viewpoint, what is measured and the edits are in its world
        self._standing: tuple[Moment, Ground | None] | None = None
        self._coloured: tuple[tuple[object, ...], GaussianArrays] | None = None
        self.paintings = 0  # of the Gaussians, which is what takes the time of a picture
        self._painted: tuple[tuple[object, ...], Canvas] | None = None

    def close(self) -> None:
        self._analyst.close()
        self.source.close()

    def receive(self) -> bool:
        """Takes what the source has; whether that was something."""
        self._follow_state()
        view = self.viewpoint()
        if isinstance(self.source, PagedSource) and view is not None:
            self.source.look_from(view.T_world_camera[:3, 3], self.state.which_map)
        moment, before = self.source.take(), self._tracked
        self._tracked = self.source.live_camera
        if moment is None:
            return self._tracked is not before
        self.history = append_moment(self.history, moment, self._memory_bytes)
        self._reset_on_world_change(self.moment or moment)
        return True

    def _follow_state(self) -> None:
        """Another moment may be shown than before, as the person goes through the history."""
        moment = self.moment
        before = self._world
        if moment is not None and before is not None and moment is not before and not same_world(before, moment):
            self._reset_on_world_change(moment)

    def _reset_on_world_change(self, shown: Moment) -> None:
        """Takes back what was said in another world than that of the moment which is shown now, and its viewpoint."""
        before, self._world = self._world, shown
        if before is not None and not same_world(before, shown):
            self._touched = self._from_outside = False
            self.state = replace(self.state, measured=(), edits=())
        if not self._touched and shown is not before and (self._view is None or shown.snapshot.cameras):
            self._choose_viewpoint(shown)

    @property
    def live_camera(self) -> CameraEstimate | None:
        """The live camera, as it was when something last came."""
        return self._tracked

    @property
    def moment(self) -> Moment | None:
        return current_moment(self.state, self.history)

    def analysis(self) -> Analysis | None:
        """The analysis of the shown moment, or of one with the same cameras; None while there is none."""
        moment = self.moment
        if moment is None or moment.graph is not None:
            return None  # of a map only a part is there: what is advised from it would be wrong
        known = self._analysis
        usable = known is not None and _same_cameras(known.moment, moment)
        if usable and not self._needs_support():
            return known  # what is advised depends on the cameras: the same ones need no second look
        self._analysis = self._analyst.request_analysis(moment) or (known if usable else None)
        if self._analysis is not None and not usable and not self._touched and self.state.advice:
            self._choose_viewpoint(moment)
        return self._analysis

    def _choose_viewpoint(self, moment: Moment) -> None:
        """Takes the viewpoint that nobody has chosen: a photographed one, or from outside if that was asked for."""
        if not self._from_outside:
            self._view = first_view(moment)
            return
        known = self._analysis if self.state.advice else None
        advised = known.advice.arrow if known is not None and _same_cameras(known.moment, moment) else None
        self._view = overview(moment, advised or ())

    def _needs_support(self) -> bool:
        return self.state.colouring in (Colouring.SUPPORT, Colouring.SOURCE)

    def press(self, key: str) -> None:
        self.state = press(self.state, self.history, key)
        self._follow_state()

    def whole_scene(self) -> None:
        """The viewpoint from which all of the scene is seen."""
        self.state = replace(self.state, camera=None, follow=False)
        self._touched, self._from_outside = False, True
        if self.moment is not None:
            self._choose_viewpoint(self.moment)

    def camera(self) -> CameraEstimate | None:
        """The camera whose viewpoint is taken, followed or chosen; None for a free one."""
        moment = self.moment
        if moment is None:
            return None
        if self.state.follow:
            return live_camera(moment, self._tracked)
        return next((camera for camera in moment.snapshot.cameras if camera.name == self.state.camera), None)

    def viewpoint(self) -> Viewpoint | None:
        """Returns the current viewpoint; None before the first moment."""
        camera = self.camera()
        if self._view is None or camera is None:
            return self._view
        return move_to_camera(self._view, camera)

    def move(self, view: Viewpoint) -> None:
        """The person takes another viewpoint, and leaves the camera's if it was one."""
        if self.state.follow or self.state.camera is not None:
            self.state = replace(self.state, camera=None, follow=False)
        self._view, self._touched = view, True

    def viewpoint_to_move(self) -> Viewpoint | None:
        """The viewpoint to start a movement from: at a camera, the pivot lies as deep as the scene's middle."""
        view, moment = self.viewpoint(), self.moment
        if view is None or moment is None or self.camera() is None:
            return view
        return set_pivot_depth(view, scene_pivot(moment))

    def shapes(self) -> Shapes:
        """Returns the shapes that are drawn beside the Gaussians."""
        moment, analysis, view, state = self.moment, self.analysis(), self.viewpoint(), self.state
        if moment is None or view is None:
            return Shapes((), ())
        advice, eye = analysis.advice if analysis else None, view.T_world_camera[:3, 3]
        standing = ground_lines(self.ground()) if state.ground else ()
        boxed = (box_lines(box(compute_crop_bounds(moment), state.box)),) if state.boxed else ()
        return merge_shapes(
            Shapes((*standing, *boxed), ()),
            shapes(moment, state, advice, self._tracked, eye),
            measurement_shapes(state.measured, eye, moment.snapshot.scale),
        )

    def shapes_with_legend(self, width: int, height: int) -> Shapes:
        """The shapes, and the legend of a picture of this size."""
        moment, view = self.moment, self.viewpoint_to_move()
        if moment is None or view is None or not self.state.ground:
            return self.shapes()
        return merge_shapes(self.shapes(), legend(view, width, height, moment.snapshot.scale))

    def ground(self) -> Ground | None:
        """Below the shown moment; None where there is nothing to stand on."""
        moment = self.moment
        if moment is None:
            return None
        if self._standing is None or self._standing[0] is not moment:
            self._standing = moment, ground(moment)
        return self._standing[1]

    def gaussians(self) -> GaussianArrays:
        """Returns the Gaussians after the edits, in the chosen colours as soon as those are known."""
        moment, analysis = self.moment, self.analysis()
        if moment is None:
            return GaussianArrays.empty()
        ready = analysis is not None and analysis.moment is moment
        colouring = Colouring.PHOTOGRAPH if self._needs_support() and not ready else self.state.colouring
        key = (moment, colouring, self.state.edits)
        if self._coloured is None or self._coloured[0] != key:
            support = analysis.support if analysis and ready else Support(np.zeros((0, 0), np.float32))
            self._coloured = key, apply_edits(colour_gaussians(moment, colouring, support), self.state.edits)
        return self._coloured[1]

    def paint(self, width: int, height: int, part: int = 1) -> Image | None:
        """(height, width, 3) the picture by the project's own rasteriser; None where nothing has come yet.

        The Gaussians are painted with one `part`-th of the width and of the height, the shapes over them in full.
        """
        view = self.viewpoint()
        if view is None:
            return None
        image = overlay_shapes(self._canvas(view, width, height, part), self.shapes_with_legend(width, height), view)
        camera, photograph = self.camera(), self.camera_image()
        if camera is None or photograph is None or self.state.blend == 0.0:
            return image
        return blend_image(image, photograph, camera, view.K(width, height), self.state.blend)

    def _canvas(self, view: Viewpoint, width: int, height: int, part: int) -> Canvas:
        """The Gaussians alone. They are painted once while nothing but shapes comes and goes."""
        gaussians, state = self.gaussians(), self.state
        key = (gaussians, view, state.gaussians, state.as_points, state.point_size, width, height, part)
        if self._painted is None or self._painted[0] != key:
            canvas = paint_coarsely(gaussians, view, state, (width, height), part)
            self._painted = key, canvas
            self.paintings += 1
        return self._painted[1]

    def camera_image(self) -> Image | None:
        """Returns the image of the camera whose viewpoint is taken; None where there is none."""
        moment, camera = self.moment, self.camera()
        return moment.snapshot.images.get(camera.name) if moment and camera else None

    def crop(self) -> None:
        """Takes away what is outside of the box. Raises EditError."""
        if self.moment is not None:
            self._edit(Selection(box=box(compute_crop_bounds(self.moment), self.state.box)))

    def keep_seen(self) -> None:
        """Takes away what no two photographs confirm. Raises EditError."""
        self._edit(Selection(only_seen=True))

    def _edit(self, edit: Selection) -> None:
        if self.moment is not None:
            edits: Edits = add_edit(self.moment, self.state.edits, edit)
            self.state = replace(self.state, edits=edits, measured=())

    def save(self, folder: Path) -> Path:
        """Writes what the edits leave as a new result in `folder`. Raises EditError, ResultWriteError."""
        if self.moment is None:
            raise EditError("There is no scene yet.")
        return write_edited(self.moment, self.state.edits, folder)

    def click(self, x: float, y: float, width: int, height: int) -> bool:
        """Goes to the camera that is seen at a pixel of the window, or measures; whether there was something."""
        if self.state.measuring:
            view = self.viewpoint()
            point = None if view is None else surface_point(self._canvas(view, width, height, 1), view, x, y)
            if point is not None:
                self.state = replace(self.state, measured=add_point(self.state.measured, point))
            return point is not None
        name = self._camera_at(x, y, width, height)
        if name is not None:
            self.state = go_to_camera(self.state, name)
        return name is not None

    def _camera_at(self, x: float, y: float, width: int, height: int) -> str | None:
        view, moment = self.viewpoint(), self.moment
        if view is None or moment is None or not self.state.cameras:
            return None
        hits = [
            (depth, photograph.name)
            for photograph in self.shapes().photographs
            if (depth := _depth_at(photograph, view, x, y, width, height)) is not None
        ]
        for camera in moment.snapshot.cameras:
            ((column, row, depth),) = project(camera.T_world_camera[None, :3, 3], view, width, height)
            if depth > 0 and camera.name != self.state.camera and np.hypot(column - x, row - y) < _CLICK_RADIUS:
                hits.append((float(depth), camera.name))
        return min(hits)[1] if hits else None


def _same_cameras(one: Moment, other: Moment) -> bool:
    names = [[camera.name for camera in moment.snapshot.cameras] for moment in (one, other)]
    return names[0] == names[1] and same_world(one, other)


def _depth_at(photograph: ImageQuad, view: Viewpoint, x: float, y: float, width: int, height: int) -> float | None:
    """How far the photograph is where it is seen at the pixel; None where it is not."""
    corners = project(photograph.corners, view, width, height)
    if corners[:, 2].min() <= 0:
        return None
    edges = np.roll(corners[:, :2], -1, 0) - corners[:, :2]
    to_pixel = np.array([x, y]) - corners[:, :2]
    sides = edges[:, 0] * to_pixel[:, 1] - edges[:, 1] * to_pixel[:, 0]
    return float(corners[:, 2].mean()) if (sides > 0).all() or (sides < 0).all() else None


# What the panel says, in plain words.

_STALE_S = 5.0  # a node that is at work is heard from more often
_MOST_DROPPED = 6
NO_SPLATS = (
    "Open3D's splat shader leaves parts of the picture black on software Vulkan: here Open3D draws points (g), "
    "and Gaussians stay with splatnode's own rasteriser"
)


def verdict_lines(moment: Moment) -> list[str]:
    """The verdict, what to do about it, and which frames it is about."""
    verdict = moment.snapshot.verdict
    lines = [f"{verdict.code.value}: {verdict.message}"]
    if verdict.advice:
        lines.append(f"What to do: {verdict.advice}")
    if verdict.frames:
        lines.append(f"About: {', '.join(verdict.frames)}")
    return lines


def count_lines(moment: Moment) -> list[str]:
    """How much there is and how long it took."""
    snapshot = moment.snapshot
    cameras = len(snapshot.cameras)
    lines = [f"{thousands(len(snapshot.gaussians))} Gaussians, {cameras} camera{'s' * (cameras != 1)}"]
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in snapshot.seconds.items() if name != "total")
    total = snapshot.seconds.get("total", sum(snapshot.seconds.values()))
    if snapshot.seconds:
        lines.append(f"{total:.1f} s" + (f" ({stages})" if stages else ""))
    if snapshot.iterations:
        lines.append(f"{thousands(snapshot.iterations)} iterations{', finished' if snapshot.final else ''}")
    return lines


def place_lines(moment: Moment) -> list[str]:
    """The places of a map, the nearest first; none for a single scene."""
    return [] if moment.graph is None else graph_lines(moment.graph)


def scale_lines(moment: Moment, ground: Ground | None) -> list[str]:
    """The unit of all lengths, and how wide the cells of the ground's grid are."""
    scale = moment.snapshot.scale
    lines = [f"Scale: {scale.sentence}"]
    return lines if ground is None else [*lines, f"Ground: cells of {format_length(ground.cell, scale)}"]


def bounds_lines(moment: Moment, camera: CameraEstimate | None = None) -> list[str]:
    """How well `camera` is known, or where there is none, or one without bounds: how well all are at least.

    With how far the poses that were given are from the estimated ones.
    """
    snapshot = moment.snapshot
    if camera is not None and camera.bounds is not None:
        bounds = format_camera_bounds(camera.bounds, snapshot.scale)
        return [f"{camera.name}: {bounds}", *describe_given_poses(moment, camera)]
    known = format_widest_bounds(snapshot.cameras, snapshot.scale)
    return [*([f"Cameras: {known}"] if known else []), *describe_given_poses(moment)]


def describe_given_poses(moment: Moment, camera: CameraEstimate | None = None) -> list[str]:
    """How far the pose that was given for `camera`, or where there is none, the worst of all, is from its estimate."""
    of = moment.snapshot.cameras if camera is None else (camera,)
    known = [(each, residual) for each in of if (residual := each.pose_residual) is not None]
    if not known:
        return []
    worst, (length, degrees) = max(known, key=lambda pair: pair[1][0])
    off = f"{format_length(length, moment.snapshot.scale)} and {degrees:.2g} degrees"
    if camera is not None:
        return [f"{worst.name}: its given pose is off by {off}"]
    return [f"Given poses: {len(known)}, at most {off} off ({worst.name})"]


def depth_lines(moment: Moment, camera: CameraEstimate | None = None) -> list[str]:
    """How many pixels of `camera`, or where there is none, of all, have multi-view consistent depth, if it is known."""
    if camera is not None:
        known = camera.consistent_depth
        return [] if known is None else [f"{camera.name}: other views confirm {format_percent(known)} of its depth"]
    total = moment.snapshot.consistent_depth
    if total is None:
        return []
    least = min(view_shares(moment), key=lambda share: share[1])
    of_all = f"Depth: other views confirm it in {format_percent(total)} of the pixels"
    return [f"{of_all}, least in {least[0]}: {format_percent(least[1])}"]


def view_shares(moment: Moment) -> list[tuple[str, float]]:
    """Each view's name and its share of pixels with multi-view consistent depth, where that is known."""
    known = ((camera.name, camera.consistent_depth) for camera in moment.snapshot.cameras)
    return [(name, share) for name, share in known if share is not None]


def view_depth_lines(moment: Moment, most: int) -> list[str]:
    """The share of each view, the smallest first; of more than `most` views the number of the others."""
    shares = sorted(view_shares(moment), key=lambda share: share[1])
    lines = [f"{name}: {format_percent(share)}" for name, share in shares[:most]]
    return lines + [f"{len(shares) - most} more, with larger shares"] * (len(shares) > most)


def rejection_lines(moment: Moment, most: int = _MOST_DROPPED) -> list[str]:
    """The frames that were left out, the latest last, each with its reason; of more than `most` only their number."""
    dropped = moment.snapshot.dropped
    lines = [f"left out {frame.name}: {frame.reason}" for frame in dropped[-most:]]
    earlier = len(dropped) - len(lines)
    return [f"{earlier} photographs were left out before:"] * (earlier > 0) + lines


def advice_line(advice: Advice | None, moment: Moment) -> str:
    """The next view; where the verdict says what to do, that comes first."""
    if moment.snapshot.final and moment.snapshot.verdict.publishable and not moment.snapshot.cameras:
        return "not known, because the file tells of no cameras."
    if not moment.snapshot.cameras or not moment.snapshot.verdict.publishable:
        return moment.snapshot.verdict.advice or "Take photographs that overlap, with a step to the side."
    if moment.graph is not None:
        return "not worked out for a map of several scenes."
    return "looking for the best next view" if advice is None else advice.sentence


def time_line(state: ViewerState, history: History) -> str:
    """Describes the position of the current moment on the time axis."""
    if not history:
        return "nothing has come yet"
    index, count = moment_index(state, history), len(history)
    shown = state.held if state.held is not None else history[-1]
    ago = history[-1].received_s - shown.received_s
    newer = count - 1 - index
    place = f"snapshot {index + 1} of {count}"
    return f"{place}, {ago:.0f} s before the newest" if newer else f"{place}, the newest"


def feed_line(age_s: float | None, final: bool) -> str:
    """How the connection is; `age_s` is None for a result on disk, infinite before anything came."""
    if age_s is None:
        return "a finished result" if final else "a result that was not final"
    if age_s == float("inf"):
        return "waiting for splatnode recon: nothing has come yet"
    if final:
        return "the scene is finished"
    if age_s > _STALE_S:
        return f"STALE: nothing has come for {age_s:.0f} s"
    return "live"


def waiting_line(age_s: float | None) -> str:
    """Describes the state of the feed before there is a scene."""
    if age_s is not None and age_s <= _STALE_S:
        return "splatnode recon is there: waiting for its first scene"
    return feed_line(age_s, final=False)


def thousands(number: int) -> str:
    """12345 as "12 345"."""
    return f"{number:,}".replace(",", " ")
