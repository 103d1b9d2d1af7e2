"""Free space: of a final scene, of one that grows, and of all scenes of a map in one frame."""

from __future__ import annotations

import logging
import math
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.terminal import Problems, event, is_logged
from splatnode.recon.core import give_back_memory
from splatnode.recon.daemon import ReconState
from splatnode.recon.daemon.relocalization import FinalScene
from splatnode.recon.geometry import align_cameras
from splatnode.recon.occupancy import (
    LONGEST_SIDE,
    MOST_VOXELS,
    NoMap,
    OccupancyMap,
    VoxelState,
    ignore_cancel,
    occupancy_map,
)
from splatnode.recon.occupancy.files import encode_npz, read_to_map
from splatnode.recon.priors import Pointmap, compute_consistent_depths
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.stored_snapshot import read_depths
from splatnode.recon.result.submap_index import FILE, JoinedMap, MapSet, read_map_set
from splatnode.recon.threads import RunContext, apply_thread_limit

Array = npt.NDArray[np.float64]

# One map of several scenes: their maps, each in a frame of its own, brought into that of the first.
#
# What is called free stays free only where a part says so of a whole neighbourhood: the parts lie to each other as
# their links tell, and no voxel of one is a voxel of another.

MARGIN = 0.5  # voxels, beside a voxel's own extent, in which a part must know all as free: parts lie so exactly at best
_STEPS = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
_DENSE = np.stack(np.meshgrid(*[np.linspace(-0.499, 0.499, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
_AT_ONCE = 2_000_000  # voxels


@dataclass(frozen=True, eq=False)
class PlacedMap:
    """The map of a scene, and where its scene lies in the world of all."""

    occupancy: OccupancyMap
    placement: Placement

    @property
    def voxel(self) -> float:
        """Returns the side of a voxel in the unit of all."""
        return self.placement.scale * self.occupancy.voxel

    def transform_to_all(self, points: Array) -> Array:
        """The points (M, 3) of this map's frame in the world of all."""
        T = self.occupancy.T_world_map
        return self.placement.transform_points(points @ T[:3, :3].T + T[:3, 3])

    def transform_to_own(self, points: Array) -> Array:
        """The points (M, 3) of the world of all in this map's frame."""
        T = self.occupancy.T_world_map
        return (self.placement.inverse().transform_points(points) - T[:3, 3]) @ T[:3, :3]


def combine_maps(
    parts: Sequence[PlacedMap], pause: Callable[[], None] = ignore_cancel, base: OccupancyMap | None = None
) -> OccupancyMap:
    """The map of all parts, in the frame of the first and in the unit that the placements lead to.

    With `base`, which this made of other parts, they are added to it, in its frame and with its voxels.

    A voxel is occupied where any part has a surface, free where a part knows all of it and MARGIN beside it as free,
    and no other has a surface there. Voxels are as large as the largest of the parts, and larger where there would be
    too many. `pause` is called between parts, and may raise. Raises ValueError without a part.
    """
    if not parts:
        raise ValueError("a map of several scenes needs at least one, got none")
    first = parts[0]
    T = np.eye(4)
    T[:3, :3] = first.placement.rotation @ first.occupancy.T_world_map[:3, :3]
    T[:3, 3] = first.transform_to_all(np.zeros((1, 3)))[0]
    T = T if base is None else base.T_world_map
    known = [(_find_known_corners(part) - T[:3, 3]) @ T[:3, :3] for part in parts]
    states, start, voxel = _lay_out(known, max(part.voxel for part in parts), base)
    for part, points in zip(parts, known, strict=True):
        pause()
        for index in _list_voxels(points, start, voxel, states.shape):
            free = tuple(index[_is_free(part, index, start, voxel, T)].T)
            states[free] = np.where(states[free] == VoxelState.OCCUPIED, VoxelState.OCCUPIED, VoxelState.FREE)
    for part in parts:
        pause()
        index = np.floor(((_sample_occupied(part) - T[:3, 3]) @ T[:3, :3]) / voxel).astype(np.int64) - start
        inside = ((index >= 0) & (index < states.shape)).all(1)
        states[tuple(index[inside].T)] = VoxelState.OCCUPIED
    frame = replace(first.occupancy.upright, T_world_map=T) if base is None else base.upright
    return OccupancyMap(
        states, voxel, start.astype(np.float64) * voxel, frame, first.occupancy.scale if base is None else base.scale
    )


def _lay_out(
    known: Sequence[Array], voxel: float, base: OccupancyMap | None
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64], float]:
    """States for boxes (8, 3) and `base`, which they hold; the number of the first voxel along each axis, and its side.

    Raises ValueError where `base` would get too many voxels.
    """
    points = np.concatenate(known)
    low, high = points.min(0), points.max(0)
    if base is not None:
        voxel = base.voxel
        low, high = np.minimum(low, base.origin), np.maximum(high, base.origin + voxel * np.array(base.states.shape))
    while np.prod((high - low) / voxel + 3) > MOST_VOXELS or (high - low).max() / voxel > LONGEST_SIDE:
        if base is not None:
            raise ValueError(f"the map would have more than {MOST_VOXELS} voxels of {voxel:g}; choose a larger voxel")
        voxel *= 2
    start = np.floor(low / voxel).astype(np.int64) - 1
    states = np.zeros(tuple((np.ceil(high / voxel).astype(np.int64) + 1 - start).tolist()), np.uint8)
    if base is not None:
        _copy_states(base, np.round(base.origin / voxel).astype(np.int64) - start, states)
    return states, start, voxel


def _copy_states(base: OccupancyMap, at: npt.NDArray[np.int64], states: npt.NDArray[np.uint8]) -> None:
    """Copies the states of `base` into larger ones, its first voxel to the number `at` (3,)."""
    x, y, z = at.tolist()
    a, b, c = base.states.shape
    states[x : x + a, y : y + b, z : z + c] = base.states


def _find_known_corners(part: PlacedMap) -> Array:
    """(8, 3) the corners, in the world of all, of the box around what the part knows; of all where that is none."""
    known = np.argwhere(part.occupancy.states != VoxelState.NOT_SEEN)
    low, high = (known.min(0), known.max(0) + 1) if len(known) else (np.zeros(3), np.array(part.occupancy.states.shape))
    box = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    return part.transform_to_all(part.occupancy.origin + box * part.occupancy.voxel)


def _list_voxels(
    corners: Array, start: npt.NDArray[np.int64], voxel: float, shape: tuple[int, ...]
) -> Iterator[npt.NDArray[np.int64]]:
    """Yields (M, 3) numbers of the voxels in the box around `corners` (8, 3), in the frame of all, some at a time."""
    low = np.maximum(np.floor(corners.min(0) / voxel).astype(np.int64) - start, 0)
    high = np.minimum(np.ceil(corners.max(0) / voxel).astype(np.int64) - start, np.array(shape))
    rows = max(1, _AT_ONCE // max(1, int(np.prod(high[1:] - low[1:]))))
    for first in range(low[0], high[0], rows):
        box = [(first, min(first + rows, high[0])), (low[1], high[1]), (low[2], high[2])]
        yield np.stack(np.meshgrid(*(np.arange(a, b) for a, b in box), indexing="ij"), -1).reshape(-1, 3)


def _is_free(
    part: PlacedMap, index: npt.NDArray[np.int64], start: npt.NDArray[np.int64], voxel: float, T: Array
) -> npt.NDArray[np.bool_]:
    """(M,) which of the voxels `index` (M, 3) the part knows as free, whole and with MARGIN around."""
    free = np.ones(len(index), bool)
    for step in sorted(_STEPS.tolist(), key=lambda each: float(np.abs(each).sum())):  # the centre first: few are left
        points = (index[free] + start + 0.5 + (0.5 + MARGIN) * np.array(step)) * voxel
        own = part.transform_to_own(points @ T[:3, :3].T + T[:3, 3])
        own_index = np.floor((own - part.occupancy.origin) / part.occupancy.voxel).astype(np.int64)
        inside = ((own_index >= 0) & (own_index < part.occupancy.states.shape)).all(1)
        found = np.zeros(len(points), bool)
        found[inside] = part.occupancy.states[tuple(own_index[inside].T)] == VoxelState.FREE
        free[free] = found
    return free


def _sample_occupied(part: PlacedMap) -> Array:
    """(M, 3) points in the world of all, 125 of each occupied voxel, evenly spread."""
    index = np.argwhere(part.occupancy.states == VoxelState.OCCUPIED)
    points = (index[:, None] + 0.5 + _DENSE).reshape(-1, 3)
    return part.transform_to_all(part.occupancy.origin + points * part.occupancy.voxel)


# The map of the active submap: which space is free, occupied, or not seen; made in spare moments, of final scenes.

NOT_FINAL = "a map is made of a scene that is final: when no keyframe has come for a while"
LOST = "the last keyframes do not belong to the scene: where the robot is now is not known"


class OccupancyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    live: bool = False  # send the map of each scene that is final, as the service recon.map
    # With `live`: send a map of the scene while it grows, too, marked provisional. It is less certain, and changes
    provisional: bool = False
    # Keep a file out/free_space/MAP.npz for each map: the free space of all its final scenes, in one frame
    maps: bool = False
    # Side of a voxel, in the unit of the scene; nothing: as `splatnode occupancy` chooses it
    voxel: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None


@dataclass(frozen=True, eq=False)
class OccupancyResult:
    """The occupancy map of a scene, or the reason why there is none."""

    of: FinalScene
    occupancy: OccupancyMap | None
    why: str = ""  # there is none


class OccupancyMapper:
    """Maps the active submap. `map_scene` is for the thread that works; any thread may ask for `find_current_map`."""

    def __init__(self, config: OccupancyConfig) -> None:
        self._config = config
        self._made: OccupancyResult | None = None

    def map_scene(self, finished: FinalScene | None, state: ReconState, folder: Path, run: RunContext) -> bool:
        """Maps the final scene, of which `folder` is the result; False where there was nothing to do.

        What a pause raises ends the work.
        """
        if not self._config.live or finished is None or state is ReconState.LOST or self._is_map_of(finished):
            return False
        try:
            snapshot = _add_depths(finished.snapshot, folder)
            occupancy, why = occupancy_map(snapshot, self._config.voxel, pause=run.pause), ""
        except ValueError as error:
            occupancy, why = None, str(error)
        self._made = OccupancyResult(finished, occupancy, why)
        shares = {} if occupancy is None else {name: round(share, 4) for name, share in occupancy.shares.items()}
        event(log, logging.INFO, "map", why=why, **shares)
        return True

    def find_current_map(self, finished: FinalScene | None, state: ReconState) -> OccupancyResult | str:
        """The map of this scene as it is now, or why there is none."""
        if state is ReconState.LOST:
            return LOST
        made = self._made
        return made if made is not None and made.of is finished else NOT_FINAL

    def _is_map_of(self, finished: FinalScene) -> bool:
        return self._made is not None and self._made.of is finished


def _add_depths(snapshot: Snapshot, folder: Path) -> Snapshot:
    """Adds the multi-view consistent depths, from the result folder if an earlier process made the scene."""
    if snapshot.depths or not folder.is_dir():
        return snapshot
    try:
        depths, written = read_depths(folder), read_cameras(folder / "cameras.json")
    except (OSError, ValueError) as error:
        raise_shortage(error)
        log.warning("the depths in %s cannot be read: %s", folder, error)
        return snapshot
    poses = {camera.name: camera.T_world_camera for camera in written}
    ours = [(camera.T_world_camera, poses.get(camera.name)) for camera in snapshot.cameras]
    same = all(pose is not None and np.allclose(shown, pose, rtol=0, atol=1e-6) for shown, pose in ours)
    return replace(snapshot, depths=depths) if same else snapshot


# The thread that maps free space while a scene grows; what it makes is provisional, and is withdrawn with the world.
#
# It maps the newest scene that is shown, and then the newest again: a keyframe waits for no map, and a map for no
# pause.

log = logging.getLogger(__name__)

WAIT_S = 0.05  # for a scene
MOST_OFF = 0.02  # of the median depth, by which the cameras of depths may miss those of the scene: else they are old
OLD_DEPTHS = "the depths of the scene are being estimated anew"


@dataclass(frozen=True, eq=False)
class GrowingScene:
    """A scene that viewers see while it grows, with the depths that it grows from."""

    snapshot: Snapshot
    scene_id: str
    sequence: int  # of the message that shows it
    revision: int  # of its world
    pointmaps: Mapping[str, Pointmap]  # by keyframe, in a world of their own
    shown_s: float  # monotonic


@dataclass(frozen=True, eq=False)
class ProvisionalMap:
    """The map of a scene that grows, or the reason why there is none."""

    of: GrowingScene
    occupancy: OccupancyMap | None
    why: str = ""


class GrowingMapper:
    """Maps what it is shown. `show` is for the thread that shows scenes, `run` for one of its own; any may read."""

    def __init__(self, voxel: float | None, problems: Problems, stopping: threading.Event) -> None:
        """`voxel` is its side, in the unit of the scene; None: as `occupancy_map` chooses it."""
        self._voxel, self._problems, self._stopping = voxel, problems, stopping
        self._pause = _make_pause(stopping)
        self._newest: GrowingScene | None = None
        self.made: ProvisionalMap | None = None  # the newest

    def show(self, scene: GrowingScene) -> None:
        self._newest = scene

    def run(self) -> None:
        """Until the daemon stops."""
        mapped: GrowingScene | None = None
        with apply_thread_limit(1):
            while not self._stopping.wait(WAIT_S):
                scene = self._newest
                if scene is None or scene is mapped:
                    continue
                mapped = scene
                try:
                    self.made = map_growing_scene(scene, self._voxel, self._pause)
                except _Stopping:
                    return
                except Exception as error:  # of one scene; the next one may do
                    self.made = ProvisionalMap(scene, None, f"the map failed: {type(error).__name__}")
                    why = f"{type(error).__name__}: {error}"
                    if is_logged(self._problems.add("growing scenes that could not be mapped", why)):
                        log.exception("a growing scene could not be mapped")
                after_s = round(time.monotonic() - scene.shown_s, 2)
                event(log, logging.INFO, "provisional_map", views=len(scene.snapshot.cameras), after_s=after_s)
                give_back_memory()


class _Stopping(Exception):
    """The daemon stops."""


def _make_pause(stopping: threading.Event) -> Callable[[], None]:
    """Returns a `pause` that raises _Stopping once the daemon stops."""

    def pause() -> None:
        if stopping.is_set():
            raise _Stopping

    return pause


def drop_normals(pointmaps: Mapping[str, Pointmap]) -> dict[str, Pointmap]:
    """The point maps with what a map of free space is made of alone: the rest is most of their memory."""
    nothing = np.zeros((0, 0, 3), np.float32)
    return {name: replace(each, normal=nothing, unchecked=None) for name, each in pointmaps.items()}


def map_growing_scene(scene: GrowingScene, voxel: float | None, pause: Callable[[], None]) -> ProvisionalMap:
    """Maps what the photographs so far show at depths that two of them confirm. `pause` may raise to abandon it."""
    try:
        snapshot = add_growing_depths(scene.snapshot, scene.pointmaps)
        if snapshot is None:
            return ProvisionalMap(scene, None, OLD_DEPTHS)
        return ProvisionalMap(scene, occupancy_map(snapshot, voxel, pause=pause))
    except ValueError as error:
        return ProvisionalMap(scene, None, str(error))


def add_growing_depths(snapshot: Snapshot, pointmaps: Mapping[str, Pointmap]) -> Snapshot | None:
    """The snapshot with the depths that two views confirm, in its unit; None where they are of other cameras.

    A camera without a point map has none.
    """
    cameras = [camera for camera in snapshot.cameras if camera.name in pointmaps]
    if len(cameras) < 2:
        return None
    known = [pointmaps[camera.name] for camera in cameras]
    own, shown = (np.stack([each.T_world_camera for each in side]) for side in (known, cameras))
    by = align_cameras(own, shown)
    depths = np.concatenate([each.depth[each.depth > 0] for each in known])
    if not len(depths):
        return None
    off = np.linalg.norm(by(own[:, :3, 3]) - shown[:, :3, 3], axis=1).max()
    if off > MOST_OFF * by.scale * float(np.median(depths)):
        return None
    factor = np.float32(by.scale)
    consistent = compute_consistent_depths(known)
    return replace(snapshot, depths={name: (depth * factor).astype(np.float16) for name, depth in consistent.items()})


# The thread that keeps a file of each map's free space: of all its final scenes, in one frame, as links join them.
#
# It reads what the node writes: the index of submaps, and the results of final scenes. A file is written anew when a
# scene becomes final, when a loop joins or moves scenes, and is removed when its map is no more. A scene that grows,
# and shares photographs with one of the map, is added, marked, and taken out again with its world.

FOLDER = "free_space"  # in the folder of the results
LOOK_S = 0.5  # between looks at the index
AGAIN_S = 10.0  # after something could not be read or written
GROWING_EVERY_S = 3.0  # between files with the scene that grows
LEAST_SHARED = 3  # photographs of two scenes that tell how these lie to each other
MOST_OFF_SHARED = 0.05  # of how far the shared cameras are apart, by which two scenes may disagree on one

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
        self._pause = _make_pause(stopping)
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
        for name, place in found.submaps.items():
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
            made = occupancy_map(read_to_map(folder), self._voxel, pause=self._pause)
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
        whole = combine_maps(placed, self._pause)
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
                whole = combine_maps([part], self._pause, self._wholes[joined.name])
                self._write_file(joined.name, whole, made.of.scene_id)
                self._grown = joined.name, made
                return True
        return False


def _mark_new(whole: OccupancyMap, base: OccupancyMap) -> npt.NDArray[np.bool_]:
    """(X, Y, Z) the voxels of `whole` that are another than in `base`, which it was made of."""
    before = np.zeros_like(whole.states)
    _copy_states(base, np.round((base.origin - whole.origin) / whole.voxel).astype(np.int64), before)
    return before != whole.states


def find_shared_placement(cameras: Sequence[CameraEstimate], found: MapSet, joined: JoinedMap) -> Placement | None:
    """Finds where a scene with these cameras lies in a map, by the photographs that it shares with one of its scenes.

    None where it shares less than LEAST_SHARED with any, or these do not lie to each other alike.
    """
    own = {camera.name: camera.T_world_camera for camera in cameras}
    for name in reversed(list(joined.placements)):  # it most likely goes on from the newest
        place = found.submaps[name]
        if place.folder is None or len(own.keys() & set(place.frames_used)) < LEAST_SHARED:
            continue
        there = {camera.name: camera.T_world_camera for camera in read_cameras(place.folder / "cameras.json")}
        shared = [each for each in own if each in there]
        if len(shared) < LEAST_SHARED:
            continue
        Ts_own, Ts_there = (np.stack([side[each] for each in shared]) for side in (own, there))
        by = align_cameras(Ts_own, Ts_there)
        off = np.linalg.norm(by(Ts_own[:, :3, 3]) - Ts_there[:, :3, 3], axis=1).max()
        if off <= MOST_OFF_SHARED * float(np.ptp(Ts_there[:, :3, 3], axis=0).max()):
            return joined.placements[name].after(Placement(by.scale, by.rotation, by.translation))
    return None


def _describe(placement: Placement) -> tuple[float, ...]:
    """The numbers of a placement, to compare it by."""
    return placement.scale, *placement.rotation.ravel().tolist(), *placement.translation.tolist()
