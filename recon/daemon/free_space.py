"""The map of the present scene: which space is free, occupied, or not seen; made in spare moments, of final scenes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from splatnode.capture.process.logs import event
from splatnode.capture.process.system import raise_shortage
from splatnode.recon.daemon.relocalization import FinalScene
from splatnode.recon.daemon.status import ReconState
from splatnode.recon.occupancy.grid import OccupancyMap, occupancy_map
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.npz_files import read_depths
from splatnode.recon.result.snapshot import Snapshot

log = logging.getLogger(__name__)

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
    """Maps the present scene. `map_scene` is for the thread that works; any thread may ask for `find_current_map`."""

    def __init__(self, config: OccupancyConfig) -> None:
        self._config = config
        self._made: OccupancyResult | None = None

    def map_scene(
        self, finished: FinalScene | None, state: ReconState, folder: Path, pause: Callable[[], None]
    ) -> bool:
        """Maps the final scene, of which `folder` is the result; False where there was nothing to do.

        What `pause` raises ends the work.
        """
        if not self._config.live or finished is None or state is ReconState.LOST or self._is_map_of(finished):
            return False
        try:
            snapshot = _add_depths(finished.snapshot, folder)
            occupancy, why = occupancy_map(snapshot, self._config.voxel, pause=pause), ""
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
