"""All that a node has made, as a source of moments: a map of many scenes, loaded as the eye moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export import SceneFileError
from splatnode.recon.result.pieces import Pieces, find_pieces, has_scene
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.result.whole import JoinedMap, MapSet, read_map_set
from splatnode.viewer.graph import NOTHING, Array, Graph, GraphEdge, GraphNode
from splatnode.viewer.map_loader import MapLoader
from splatnode.viewer.moment import Moment

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
        without = [scene_id for scene_id, place in self._whole.places.items() if not has_scene(place)]
        for scene_id in dict.fromkeys([*self._of.placements, *without]):
            place = self._whole.places[scene_id]
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
    return [each for each in whole.maps if any(has_scene(whole.places[scene_id]) for scene_id in each.placements)]


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
