"""The thread that keeps a file of each map's free space: of all its final scenes, in one frame, as links join them.

It reads what the node writes: the index of places, and the results of final scenes. A file is written anew when a scene
becomes final, when a loop joins or moves scenes, and is removed when its map is no more.
"""

from __future__ import annotations

import logging
import threading
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatnode.capture.process.logs import Problems, event, is_logged
from splatnode.capture.process.system import raise_shortage
from splatnode.recon.core import give_back_memory
from splatnode.recon.occupancy.combine import PlacedMap, combine_maps
from splatnode.recon.occupancy.command import read_to_map
from splatnode.recon.occupancy.formats.npz import encode_npz
from splatnode.recon.occupancy.grid import NoMap, OccupancyMap, occupancy_map
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.submap_index import FILE, JoinedMap, MapSet, read_map_set
from splatnode.recon.threads import apply_thread_limit

log = logging.getLogger(__name__)

FOLDER = "free_space"  # in the folder of the results
LOOK_S = 0.5  # between looks at the index
AGAIN_S = 10.0  # after something could not be read or written

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

    def __init__(self, out: Path, voxel: float | None, problems: Problems, stopping: threading.Event) -> None:
        """`voxel` is its side in each scene's unit; None: as `occupancy_map` chooses it."""
        self._out, self._voxel, self._problems, self._stopping = out, voxel, problems, stopping
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
        scenes = self._map_scenes(found)
        files: dict[str, tuple[object, ...]] = {}
        for joined in found.maps:
            parts = {name: scenes[name] for name in joined.placements if name in scenes}
            if parts:
                files[joined.name] = tuple((key, _describe(joined.placements[name])) for name, key in parts.items())
                if self._written.get(joined.name) != files[joined.name]:
                    self._write(joined, parts)
        for path in (self._out / FOLDER).glob("scene-*.npz"):  # of an earlier process, too
            if path.stem not in files:
                path.unlink(missing_ok=True)
        self._written, self._seen = files, seen
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
        scenes = np.array(list(parts))
        write_files(self._out / FOLDER, {f"{joined.name}.npz": encode_npz(whole, {"scenes": scenes})})
        shares = {name: round(share, 4) for name, share in whole.shares.items()}
        event(log, logging.INFO, "whole_map", map=joined.name, scenes=len(parts), **shares)

    def _check_stopping(self) -> None:
        if self._stopping.is_set():
            raise _Stopping


class _Stopping(Exception):
    """The daemon stops."""


def _describe(placement: Placement) -> tuple[float, ...]:
    """The numbers of a placement, to compare it by."""
    return placement.scale, *placement.rotation.ravel().tolist(), *placement.translation.tolist()
