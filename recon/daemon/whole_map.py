"""The thread that keeps a file of each map's free space: of all its final scenes, in one frame, as links join them.

It reads what the node writes: the index of places, and the results of final scenes. A file is written anew when a scene
becomes final, when a loop joins or moves scenes, and is removed when its map is no more. A scene that grows, and shares
photographs with one of the map, is added, marked, and taken out again with its world.
"""

from __future__ import annotations

import logging
import math
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.process.logs import Problems, event, is_logged
from splatnode.capture.process.system import raise_shortage
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon.growing_map import ProvisionalMap
from splatnode.recon.geometry import align_cameras
from splatnode.recon.occupancy.combine import PlacedMap, combine_maps
from splatnode.recon.occupancy.command import read_to_map
from splatnode.recon.occupancy.formats.npz import encode_npz
from splatnode.recon.occupancy.grid import NoMap, OccupancyMap, occupancy_map
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.submap_index import FILE, JoinedMap, MapSet, read_map_set
from splatnode.recon.threads import apply_thread_limit

log = logging.getLogger(__name__)

FOLDER = "free_space"  # in the folder of the results
LOOK_S = 0.5  # between looks at the index
AGAIN_S = 10.0  # after something could not be read or written
GROWING_EVERY_S = 3.0  # between files with the scene that grows
LEAST_SHARED = 3  # photographs of two scenes that tell how these lie to each other
MOST_OFF = 0.05  # of how far the shared cameras are apart, by which two scenes may disagree on one

_Key = tuple[str, int, int]  # folder of a result, and when and how large its depths were written


@dataclass(frozen=True, eq=False)
class _SceneMap:
    """The map of a final scene, its states packed: nobody needs them until the next scene is final."""

    occupancy: OccupancyMap  # without its states
    shape: tuple[int, int, int]
    packed: bytes

    def unpack(self) -> OccupancyMap:
        states = np.frombuffer(zlib.decompress(self.packed), np.uint8).reshape(self.shape)
        return replace(self.occupancy, states=states)


class WholeMapper:
    """Keeps the files of `out`/free_space. `run` is for a thread of its own."""

    def __init__(
        self,
        out: Path,
        voxel: float | None,
        problems: Problems,
        stopping: threading.Event,
        find_growing: Callable[[], ProvisionalMap | None] | None = None,
    ) -> None:
        """`voxel` is its side in each scene's unit; None: as `occupancy_map` chooses it.

        `find_growing` returns the map of the scene that grows, if there is one; None: it is not added.
        """
        self._out, self._voxel, self._problems, self._stopping = out, voxel, problems, stopping
        self._find_growing = find_growing
        self._found: MapSet | None = None
        self._parts: dict[str, dict[str, _Key]] = {}  # by map, the maps of its scenes
        self._wholes: dict[str, OccupancyMap] = {}  # of the final scenes, by map; only with a scene that grows
        self._grown: tuple[str, ProvisionalMap] | None = None  # the map that a growing scene is in, and its own
        self._grown_s = -math.inf  # monotonic
        self._scenes: dict[_Key, _SceneMap | None] = {}  # None: it has no map
        self._written: dict[str, tuple[object, ...]] = {}  # by map, what its file was made of
        self._seen: tuple[int, int] | None = None  # the index, as it was last worked on

    def run(self) -> None:
        """Until the daemon stops."""
        with apply_thread_limit(1):
            wait_s = LOOK_S
            while not self._stopping.wait(wait_s):
                wait_s = LOOK_S
                try:
                    self.update()
                    if self._find_growing is not None:
                        self.update_growing(self._find_growing())
                except _Stopping:
                    return
                except Exception as error:  # the next one may do
                    wait_s = AGAIN_S
                    why = f"{type(error).__name__}: {error}"
                    if is_logged(self._problems.add("maps of all scenes that could not be written", why)):
                        log.exception("the map of all scenes could not be written")

    def update(self) -> bool:
        """Writes what has changed; False where nothing has. Raises OSError, SceneFileError."""
        try:
            stat = (self._out / FILE).stat()
        except FileNotFoundError:
            return False
        seen = stat.st_mtime_ns, stat.st_size
        if seen == self._seen:
            return False
        found = read_map_set(self._out)
        self._found = found
        scenes = self._map_scenes(found)
        files: dict[str, tuple[object, ...]] = {}
        for joined in found.maps:
            parts = {name: scenes[name] for name in joined.placements if name in scenes}
            if parts:
                files[joined.name] = tuple((key, _describe(joined.placements[name])) for name, key in parts.items())
                self._parts[joined.name] = parts
                if self._written.get(joined.name) != files[joined.name]:
                    self._write(joined, parts)
        for path in (self._out / FOLDER).glob("scene-*.npz"):  # of an earlier process, too
            if path.stem not in files:
                path.unlink(missing_ok=True)
        self._written, self._seen = files, seen
        self._wholes = {name: made for name, made in self._wholes.items() if name in files}
        self._scenes = {key: made for key, made in self._scenes.items() if key in set(scenes.values())}
        give_back_memory()
        return True

    def _map_scenes(self, found: MapSet) -> dict[str, _Key]:
        """The keys of the maps of all final scenes that have one, by scene."""
        keys = {}
        for name, place in found.places.items():
            if place.folder is None or place.provisional or not place.publishable:
                continue
            try:
                stat = (place.folder / "depth.npz").stat()
            except FileNotFoundError:
                continue
            key = str(place.folder), stat.st_mtime_ns, stat.st_size
            if key not in self._scenes:
                self._scenes[key] = self._map_scene(place.folder)
            if self._scenes[key] is not None:
                keys[name] = key
        return keys

    def _map_scene(self, folder: Path) -> _SceneMap | None:
        try:
            made = occupancy_map(read_to_map(folder), self._voxel, pause=self._check_stopping)
        except NoMap as error:
            log.info("%s has no map: %s", folder.name, error)
            return None
        except (OSError, SceneFileError) as error:
            raise_shortage(error)
            raise
        packed = zlib.compress(made.states.tobytes(), 1)
        x, y, z = made.states.shape
        return _SceneMap(replace(made, states=np.zeros((0, 0, 0), np.uint8)), (x, y, z), packed)

    def _write(self, joined: JoinedMap, parts: dict[str, _Key]) -> None:
        placed = []
        for name, key in parts.items():
            made = self._scenes[key]
            assert made is not None
            placed.append(PlacedMap(made.unpack(), joined.placements[name]))
        whole = combine_maps(placed, self._check_stopping)
        if self._find_growing is not None:
            self._wholes[joined.name] = whole
        self._grown = None if self._grown is None or self._grown[0] == joined.name else self._grown
        self._write_file(joined.name, whole)
        shares = {name: round(share, 4) for name, share in whole.shares.items()}
        event(log, logging.INFO, "whole_map", map=joined.name, scenes=len(parts), **shares)

    def _write_file(self, name: str, whole: OccupancyMap, scene_id: str = "") -> None:
        """Writes the map's file; with the scene `scene_id` that grows, which voxels are known by it alone."""
        further = {"scenes": np.array(list(self._parts[name])), "growing": np.array(scene_id)}
        if scene_id:
            further["provisional"] = _mark_new(whole, self._wholes[name])
        write_files(self._out / FOLDER, {f"{name}.npz": encode_npz(whole, further)})

    def update_growing(self, made: ProvisionalMap | None) -> bool:
        """Adds the scene that grows to the map that it goes on from; False where nothing is added.

        One that was added is taken out once there is no map in its world any more. Raises OSError, SceneFileError.
        """
        now_s = time.monotonic()
        if self._grown is not None and made is not self._grown[1]:
            name, before = self._grown
            if made is None or made.of.scene_id != before.of.scene_id or made.of.revision != before.of.revision:
                self._write_file(name, self._wholes[name])  # its world is withdrawn
                self._grown = None
        if made is None or made.occupancy is None or (self._grown and made is self._grown[1]):
            return False
        if self._found is None or now_s - self._grown_s < GROWING_EVERY_S:
            return False
        self._grown_s = now_s
        for joined in (each for each in self._found.maps if each.name in self._wholes):
            placement = find_shared_placement(made.of.snapshot.cameras, self._found, joined)
            if placement is not None:
                part = PlacedMap(made.occupancy, placement)
                whole = combine_maps([part], self._check_stopping, self._wholes[joined.name])
                self._write_file(joined.name, whole, made.of.scene_id)
                self._grown = joined.name, made
                return True
        return False

    def _check_stopping(self) -> None:
        if self._stopping.is_set():
            raise _Stopping


class _Stopping(Exception):
    """The daemon stops."""


def _mark_new(whole: OccupancyMap, base: OccupancyMap) -> npt.NDArray[np.bool_]:
    """(X, Y, Z) the voxels of `whole` that are another than in `base`, which it was made of."""
    before = np.zeros_like(whole.states)
    x, y, z = np.round((base.origin - whole.origin) / whole.voxel).astype(int).tolist()
    a, b, c = base.states.shape
    before[x : x + a, y : y + b, z : z + c] = base.states
    return before != whole.states


def find_shared_placement(cameras: Sequence[CameraEstimate], found: MapSet, joined: JoinedMap) -> Placement | None:
    """Finds where a scene with these cameras lies in a map, by the photographs that it shares with one of its scenes.

    None where it shares less than LEAST_SHARED with any, or these do not lie to each other alike.
    """
    own = {camera.name: camera.T_world_camera for camera in cameras}
    for name in reversed(list(joined.placements)):  # it most likely goes on from the newest
        place = found.places[name]
        if place.folder is None or len(own.keys() & set(place.frames_used)) < LEAST_SHARED:
            continue
        there = {camera.name: camera.T_world_camera for camera in read_cameras(place.folder / "cameras.json")}
        shared = [each for each in own if each in there]
        if len(shared) < LEAST_SHARED:
            continue
        Ts_own, Ts_there = (np.stack([side[each] for each in shared]) for side in (own, there))
        by = align_cameras(Ts_own, Ts_there)
        off = np.linalg.norm(by(Ts_own[:, :3, 3]) - Ts_there[:, :3, 3], axis=1).max()
        if off <= MOST_OFF * float(np.ptp(Ts_there[:, :3, 3], axis=0).max()):
            return joined.placements[name].after(Placement(by.scale, by.rotation, by.translation))
    return None


def _describe(placement: Placement) -> tuple[float, ...]:
    """The numbers of a placement, to compare it by."""
    return placement.scale, *placement.rotation.ravel().tolist(), *placement.translation.tolist()
