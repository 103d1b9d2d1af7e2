"""The thread that maps free space while a scene grows; what it makes is provisional, and is withdrawn with the world.

It maps the newest scene that is shown, and then the newest again: a keyframe waits for no map, and a map for no pause.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from splatnode.capture.process.logs import Problems, event, is_logged
from splatnode.recon.core import give_back_memory
from splatnode.recon.geometry import align_cameras
from splatnode.recon.occupancy.grid import OccupancyMap, occupancy_map
from splatnode.recon.priors.pointmap import Pointmap, compute_consistent_depths
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.threads import apply_thread_limit

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
                    self.made = map_growing_scene(scene, self._voxel, self._check_stopping)
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

    def _check_stopping(self) -> None:
        if self._stopping.is_set():
            raise _Stopping


class _Stopping(Exception):
    """The daemon stops."""


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
