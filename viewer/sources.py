"""Where moments come from: a result on disk, or a running node."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from splatnode.capture.messaging.network import RECON_DEPTH, RECON_SCENE, RECON_STATUS, Network
from splatnode.capture.messaging.pubsub import StateClient, Subscriber
from splatnode.capture.process.terminal import Problems, is_logged
from splatnode.recon.daemon import ReconStatus, WorldRecord
from splatnode.recon.result.export import SceneFileError, sanitize_gaussians
from splatnode.recon.result.export.limits import select_gaussians
from splatnode.recon.result.levels_of_detail import concatenate_gaussians, find_far_shell, make_detail_levels
from splatnode.recon.result.message import (
    CameraRecord,
    DepthHeader,
    SceneHeader,
    add_depth_shares,
    decode_snapshot,
    parse_camera,
)
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.stored_snapshot import (
    SHELL_PIECE,
    Piece,
    Pieces,
    find_pieces,
    has_scene,
    load_images,
    read_result,
)
from splatnode.recon.result.submap_index import JoinedMap, MapSet, read_map_set
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.viewer.state import FULL, NOTHING, Array, Graph, GraphEdge, GraphNode, Moment

log = logging.getLogger(__name__)

_POLL_S = 0.25
_DEPTH_S = 0.3  # that a scene waits for the message about its depth; an older node sends none


class Source(Protocol):
    def take(self) -> Moment | None:
        """The newest moment, once; None where nothing has come since. Never waits."""

    @property
    def age_s(self) -> float | None:
        """Seconds since something came; None where nothing more will."""

    @property
    def live_camera(self) -> CameraEstimate | None:
        """Returns the live camera in the newest scene; None where it is not known."""

    def close(self) -> None: ...


@runtime_checkable
class PagedSource(Protocol):
    """A source that has more than fits into memory, and gives what is near."""

    def look_from(self, eye: npt.NDArray[np.float64], which: int) -> None:
        """Sets the viewpoint's position (3,) and the map that it looks at. Never waits."""


class FixedSource:
    """One moment that is there from the start."""

    age_s = None
    live_camera = None

    def __init__(self, moment: Moment) -> None:
        self._moment: Moment | None = moment

    def take(self) -> Moment | None:
        moment, self._moment = self._moment, None
        return moment

    def close(self) -> None:
        self._moment = None


class LiveSource:
    """The scene of a running node. A thread listens; it keeps one moment, the newest."""

    def __init__(self, network: Network) -> None:
        """Raises what opening the network raises: NetworkError, KeyFileError."""
        self._client = StateClient(RECON_SCENE, network, SceneHeader)
        self._depths = StateClient(RECON_DEPTH, network, DepthHeader)
        self._depth: DepthHeader | None = None  # the newest
        self._heartbeats = Subscriber(RECON_STATUS, network, ReconStatus)
        self._refusals = Problems()
        self._newest: Moment | None = None
        self._tracked: CameraEstimate | None = None
        self.worlds: tuple[str, dict[str, WorldRecord]] = "", {}  # session, and the newest by scene
        self.scene: tuple[str, int] | None = None  # session and sequence of the newest message with a scene
        self._lock = threading.Condition()
        self._error: BaseException | None = None
        self.closed = threading.Event()  # by `close`
        self._thread = threading.Thread(target=self._listen, name="live scene", daemon=True)
        self._thread.start()

    @property
    def age_s(self) -> float:
        """A scene that is being refined is silent for long: the node's heartbeats tell that it lives."""
        return min(self._client.age_s, self._heartbeats.age_s)

    @property
    def live_camera(self) -> CameraEstimate | None:
        return self._tracked

    def take(self) -> Moment | None:
        """Raises what the connection failed with, for example NotAllowed."""
        if self._error is not None:
            raise self._error
        with self._lock:
            moment, self._newest = self._newest, None
        return moment

    def wait(self, timeout_s: float | None = None) -> Moment | None:
        """As `take`, but waits until one comes; None where none comes in time, or when it is closed."""
        with self._lock:
            self._lock.wait_for(lambda: self._newest or self._error or self.closed.is_set(), timeout_s)
        return self.take()

    def close(self) -> None:
        self.closed.set()
        with self._lock:
            self._lock.notify_all()
        self._thread.join()
        self._client.close()
        self._depths.close()
        self._heartbeats.close()

    def _listen(self) -> None:
        last: CameraRecord | None = None  # of the last heartbeat: what has not changed is not drawn again
        try:
            while not self.closed.is_set():
                message = self._client.poll(_POLL_S)
                heartbeat = self._heartbeats.latest(0)
                if heartbeat is not None:
                    worlds = {world.scene_id: world for world in heartbeat.header.worlds}
                    self.worlds = heartbeat.header.session, worlds
                if heartbeat is not None and heartbeat.header.tracked != last:
                    last = heartbeat.header.tracked
                    self._tracked = last and parse_camera(last)
                if message is None:
                    continue
                self.scene = message.header.session, message.header.sequence
                try:
                    live = decode_snapshot(message)
                    snapshot = self._attach_depth(_sanitize_snapshot(live.snapshot), self.scene)
                    moment = Moment(snapshot, time.monotonic(), live.scene_id)
                except Exception as error:  # of one scene; the next one may do
                    if is_logged(self._refusals.add("scenes that were refused", error)):
                        log.warning("a scene of the node was refused: %s", error)
                    continue
                with self._lock:
                    self._newest = moment
                    self._lock.notify_all()
        except Exception as error:
            with self._lock:
                self._error = error
                self._lock.notify_all()

    def _attach_depth(self, snapshot: Snapshot, scene: tuple[str, int]) -> Snapshot:
        """The snapshot of message `scene` with its shares of multi-view consistent depth, if these come in time."""
        deadline = time.monotonic() + _DEPTH_S
        while (depth := self._depth) is None or (depth.session, depth.scene_sequence) != scene:
            if depth is not None and depth.session == scene[0] and depth.scene_sequence > scene[1]:
                return snapshot  # a newer scene is on its way already
            message = self._depths.poll(max(0.0, deadline - time.monotonic()))
            if message is None:
                return snapshot
            self._depth = message.header
        return add_depth_shares(snapshot, depth)


def load_result(place: Path, photographs: Path | None = None) -> Moment:
    """The moment in a result's folder or a scene file, with the photographs that are found.

    They are looked for in `photographs`, or else where `read_result` tells. Raises what that raises.
    """
    snapshot, folders = read_result(place)
    images = load_images(snapshot.cameras, [photographs] if photographs else folders)
    return Moment(replace(snapshot, images=images), time.monotonic())


def _sanitize_snapshot(snapshot: Snapshot) -> Snapshot:
    """Removes Gaussians that cannot be drawn: what comes over the network is untrusted input."""
    return replace(snapshot, gaussians=sanitize_gaussians(snapshot.gaussians))


# What of a map is loaded at which detail: the near in full, the far coarsely, never more than a budget.

FOCAL_PX = 1000.0  # of a window: from `FOCAL_PX * side` on, voxels of that side are smaller than its pixels


@dataclass(frozen=True)
class Extent:
    """How large the detail of a piece is, and how far it is from the eye."""

    away: float  # distance from the eye to the nearest of it, world units; 0: the eye is in it
    order: float  # the lower, the earlier it is served: the distance to the nearest of its cameras
    counts: tuple[int, ...]  # Gaussians at FULL detail, at level 1 and so on
    sides: tuple[float, ...]  # of the voxels of level 1 and so on, world units


def choose_levels(extents: Sequence[Extent], budget: int) -> tuple[int, ...]:
    """For each piece the level to show, or NOTHING where the budget of Gaussians does not suffice.

    A piece wants the coarsest level whose voxels are below a pixel from where the eye is. The nearest is served first:
    it gets what it wants as far as the farther ones still have something coarse, if that is possible at all.
    """
    nearest_first = sorted(range(len(extents)), key=lambda index: extents[index].order)
    chosen = [NOTHING] * len(extents)
    left = budget
    for index in nearest_first:  # the coarsest of each, as many as there is room for
        coarsest = len(extents[index].counts) - 1
        if extents[index].counts[coarsest] <= left:
            chosen[index] = coarsest
            left -= extents[index].counts[coarsest]
    for index in nearest_first:
        extent = extents[index]
        if chosen[index] == NOTHING:
            continue
        room = left + extent.counts[chosen[index]]
        better = [level for level in range(_choose_level(extent), chosen[index]) if extent.counts[level] <= room]
        if better:
            chosen[index] = better[0]
            left = room - extent.counts[better[0]]
    return tuple(chosen)


def _choose_level(extent: Extent) -> int:
    """The coarsest level that suffices from there."""
    enough = [level for level, side in enumerate(extent.sides, 1) if extent.away >= FOCAL_PX * side]
    return max(enough, default=FULL)


# The pieces of a map as they are needed: files are read when the eye comes near, and forgotten when it goes.

_REACH = 90.0  # percentile of the distances of a piece's Gaussians from the middle of its cameras, which is its radius
Level = int


@dataclass(frozen=True, eq=False)
class _PieceSummary:
    """The coarse levels and the position of a piece that was read."""

    coarse: tuple[GaussianArrays, ...]
    counts: tuple[int, ...]
    sides: tuple[float, ...]
    centre: Array  # (3,)
    reach: float

    def extent(self, eye: Array, order: float) -> Extent:
        """As it is from the eye; `order` is when it is served."""
        away = float(np.linalg.norm(eye - self.centre)) - self.reach
        return Extent(max(0.0, away), order, self.counts, self.sides)


class MapLoader:
    """Keeps at most `budget` Gaussians in full or coarse, beside what is being read. To be used in one thread."""

    def __init__(self, pieces: Pieces, budget: int) -> None:
        self._pieces, self._budget = pieces, budget
        self._known: dict[str, _PieceSummary] = {}
        self._full: dict[str, GaussianArrays] = {}
        self.shown: dict[str, tuple[Level, int]] = {}  # by scene_id: the level that is loaded, and its Gaussians

    def gaussians(self) -> GaussianArrays:
        """Returns all that is loaded as one set of Gaussians."""
        parts = []
        for scene_id, (level, _) in self.shown.items():
            if level != NOTHING:
                parts.append(self._full[scene_id] if level == FULL else self._known[scene_id].coarse[level - 1])
        return concatenate_gaussians(parts)

    def look_from(self, eye: Array, changed: Callable[[], bool]) -> bool:
        """Loads and forgets one piece after the other until what is there is right for the `eye` (3,).

        After each `changed` is called, which may end it by True: the eye is elsewhere then. Returns whether anything
        has changed. Raises SceneFileError, OSError.
        """
        something = False
        for piece in sorted(self._list_unread(), key=lambda piece: _distance_to_piece(piece, eye)):
            self._read(piece)
            something = self._update_levels(eye) or something
            if changed():
                return something
        while (wanting := self._next_full_piece(eye)) is not None:
            self._read(wanting)
            something = self._update_levels(eye) or something
            if changed():
                return something
        return self._update_levels(eye) or something

    def _list_unread(self) -> list[Piece]:
        return [piece for piece in self._pieces.pieces if piece.scene_id not in self._known]

    def _next_full_piece(self, eye: Array) -> Piece | None:
        """A piece that is to be shown in full and whose Gaussians are not there."""
        levels_now = self._levels(eye)
        missing = [
            piece
            for piece in self._pieces.pieces
            if levels_now.get(piece.scene_id) == FULL and piece.scene_id not in self._full
        ]
        return min(missing, key=lambda piece: _distance_to_piece(piece, eye), default=None)

    def _levels(self, eye: Array) -> dict[str, Level]:
        order = {piece.scene_id: _distance_to_piece(piece, eye) for piece in self._pieces.pieces}
        extents = {scene_id: known.extent(eye, order[scene_id]) for scene_id, known in self._known.items()}
        return dict(zip(extents, choose_levels(list(extents.values()), self._budget), strict=True))

    def _update_levels(self, eye: Array) -> bool:
        """Forgets what is not to be there in full; whether what is shown has changed."""
        wanted = self._levels(eye)
        self._full = {scene_id: full for scene_id, full in self._full.items() if wanted.get(scene_id) == FULL}
        shown = {}
        for scene_id, level in wanted.items():
            coarse = self._known[scene_id].coarse
            if level == FULL and scene_id not in self._full:  # until it is read
                level = len(coarse) if coarse else NOTHING
            shown[scene_id] = level, 0 if level == NOTHING else self._known[scene_id].counts[level]
        before, self.shown = self.shown, shown
        return shown != before

    def _read(self, piece: Piece) -> None:
        gaussians = piece.load_gaussians()
        if not self._pieces.merged and len(self._pieces.pieces) > 1:  # the shell of one would veil the others
            gaussians = select_gaussians(gaussians, ~find_far_shell(gaussians, piece.cameras))
        self._full[piece.scene_id] = gaussians
        if piece.scene_id not in self._known:
            coarse = () if piece.scene_id == SHELL_PIECE else make_detail_levels(gaussians)
            centre = _piece_centre(piece, gaussians)
            away = np.linalg.norm(gaussians.means - centre, axis=1)
            self._known[piece.scene_id] = _PieceSummary(
                coarse=tuple(level.gaussians for level in coarse),
                counts=(len(gaussians), *(len(level.gaussians) for level in coarse)),
                sides=tuple(level.side for level in coarse),
                centre=centre,
                reach=float(np.percentile(away, _REACH)) if len(away) else 0.0,
            )


def _piece_centre(piece: Piece, gaussians: GaussianArrays) -> Array:
    """(3,) of the cameras; of the Gaussians where there are none."""
    if piece.cameras:
        return np.mean([camera.T_world_camera[:3, 3] for camera in piece.cameras], axis=0)
    return gaussians.means.mean(0, dtype=np.float64) if len(gaussians) else np.zeros(3)


def _distance_to_piece(piece: Piece, eye: Array) -> float:
    """From the eye to the nearest camera; 0 for what has none."""
    centres = [camera.T_world_camera[:3, 3] for camera in piece.cameras]
    return min((float(np.linalg.norm(eye - centre)) for centre in centres), default=0.0)


# All that a node has made, as a source of moments: a map of many scenes, loaded as the eye moves.

BUDGET = 1_500_000  # Gaussians: 90 MB, and as much again for the picture's copy
_STEP = 0.1  # world units, about a tenth of a scene's depth: smaller movements change nothing of what is loaded
_MOST_PHOTOGRAPHS = 60  # of the nearest cameras

Photographs = Callable[[tuple[CameraEstimate, ...]], dict[str, npt.NDArray[np.uint8]]]


@dataclass(frozen=True)
class Maps:
    """The folder that a node writes its scenes into, and how it is to be looked at."""

    folder: Path
    photographs: Photographs  # of the cameras that are given
    budget: int = BUDGET  # Gaussians in memory


class MapView:
    """One of the maps of a folder, and what of it is loaded."""

    def __init__(self, maps: Maps, whole: MapSet, which: int) -> None:
        self._whole, self._which, self._photographs = whole, which, maps.photographs
        self._number, self._of = len(_list_shown_maps(whole)), _list_shown_maps(whole)[which]
        self._pieces: Pieces = find_pieces(whole, self._of, maps.folder)
        self._loader = MapLoader(self._pieces, maps.budget)
        self._images: dict[str, npt.NDArray[np.uint8]] = {}

    def look_from(self, eye: Array, changed: Callable[[], bool]) -> bool:
        """See `MapLoader.look_from`."""
        return self._loader.look_from(eye, changed)

    def start(self) -> Array:
        """(3,) the middle of all cameras: what is near it is loaded first."""
        centres = [camera.T_world_camera[:3, 3] for camera in self._pieces.cameras]
        return np.mean(centres, axis=0) if centres else np.zeros(3)

    def moment(self, eye: Array) -> Moment:
        """Returns the loaded part with the graph and the cameras, of which the nearest have their images."""
        cameras = self._pieces.cameras
        near = sorted(cameras, key=lambda camera: float(np.linalg.norm(camera.T_world_camera[:3, 3] - eye)))
        missing = tuple(camera for camera in near[:_MOST_PHOTOGRAPHS] if camera.name not in self._images)
        known = self._images | self._photographs(missing)
        self._images = {camera.name: known[camera.name] for camera in near[:_MOST_PHOTOGRAPHS] if camera.name in known}
        graph = self._graph(eye)
        shown = sum(node.centre is not None for node in graph.nodes)
        message = f"A map of {shown} scene{'s' * (shown != 1)}, from {self._of.name} on."
        verdict = Verdict(Code.OK, message, "", publishable=True)
        snapshot = Snapshot(0, verdict, cameras, self._loader.gaussians(), self._images, (), 0, final=True)
        return Moment(snapshot, time.monotonic(), self._of.name, graph)

    def _graph(self, eye: Array) -> Graph:
        centres = {
            piece.scene_id: np.mean([camera.T_world_camera[:3, 3] for camera in piece.cameras], axis=0)
            for piece in self._pieces.pieces
            if piece.cameras
        }
        nodes = []
        without = [scene_id for scene_id, place in self._whole.submaps.items() if not has_scene(place)]
        for scene_id in dict.fromkeys([*self._of.placements, *without]):
            place = self._whole.submaps[scene_id]
            level, count = self._loader.shown.get(scene_id, (NOTHING, 0))
            good = any(piece.scene_id == scene_id for piece in self._pieces.pieces)
            nodes.append(GraphNode(scene_id, place.verdict, good, centres.get(scene_id), count, level))
        far = float("inf")
        nodes.sort(key=lambda node: far if node.centre is None else float(np.linalg.norm(node.centre - eye)))
        edges = tuple(
            GraphEdge(
                link.scene, link.other, np.stack([centres[link.scene], centres[link.other]]),
                link.kind == "loop", link.retracted,
            )
            for link in self._whole.links
            if link.scene in centres and link.other in centres
        )  # fmt: skip
        return Graph(tuple(nodes), edges, self._which, self._number, self._pieces.merged)


def map_moment(maps: Maps, which: int = 0) -> Moment:
    """The whole map at once, the middle in most detail. Raises SceneFileError, FileNotFoundError, OSError."""
    view = MapView(maps, _read_maps(maps), which)
    eye = view.start()
    view.look_from(eye, lambda: False)
    return view.moment(eye)


def _read_maps(maps: Maps) -> MapSet:
    """Raises SceneFileError where nothing has come yet, besides what `read_map_set` raises."""
    whole = read_map_set(maps.folder)
    if not _list_shown_maps(whole):
        raise SceneFileError(f"{maps.folder} holds no scene yet: its places.json lists none with a result")
    return whole


def _list_shown_maps(whole: MapSet) -> list[JoinedMap]:
    """Those with a scene to show."""
    return [each for each in whole.maps if any(has_scene(whole.submaps[scene_id]) for scene_id in each.placements)]


class MapSource:
    """A thread that loads what is near the eye; it keeps one moment, the newest."""

    age_s = None
    live_camera = None

    def __init__(self, maps: Maps) -> None:
        """Raises SceneFileError, FileNotFoundError, OSError where the folder cannot be read."""
        self._maps, self._whole = maps, _read_maps(maps)
        self._view = MapView(maps, self._whole, 0)
        self._eye, self._which = self._view.start(), 0
        self._changed = threading.Condition()
        self._moved, self._closing = True, False
        self._newest: Moment | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="map", daemon=True)
        self._thread.start()

    def take(self) -> Moment | None:
        """Raises what loading failed with."""
        with self._changed:
            if self._error is not None:
                raise self._error
            moment, self._newest = self._newest, None
            return moment

    def look_from(self, eye: Array, which: int) -> None:
        """Sets the viewpoint's position and the map that it looks at: any number, as maps follow in a circle."""
        which %= len(_list_shown_maps(self._whole))
        with self._changed:
            if which != self._which or float(np.linalg.norm(eye - self._eye)) > _STEP:
                self._eye, self._moved = np.array(eye), True
                self._which = which
                self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        shown, fresh = 0, True  # nothing of the map has been shown yet
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._moved or self._closing)
                    if self._closing:
                        return
                    eye, which, self._moved = self._eye, self._which, False
                if which != shown:
                    self._view = MapView(self._maps, self._whole, which)
                    eye, shown, fresh = self._view.start(), which, True
                if self._view.look_from(eye, lambda eye=eye: self._show(eye)) or fresh:
                    self._show(eye)
                fresh = False
        except BaseException as error:
            with self._changed:
                self._error = error

    def _show(self, eye: Array) -> bool:
        """Makes what is loaded the newest moment; whether the loading should begin anew from elsewhere."""
        moment = self._view.moment(eye)
        with self._changed:
            self._newest = moment
            return self._moved or self._closing
