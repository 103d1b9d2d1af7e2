"""OccupancyMap: which parts of a place are free, occupied, or not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from os import PathLike
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.upright import Upright
from splatnode.recon.result.scale import RELATIVE, Scale


class VoxelState(IntEnum):
    """The state of a voxel: free, occupied, or not seen."""

    NOT_SEEN = 0
    FREE = 1  # rays of confirmed depth passed all of it
    OCCUPIED = 2  # a surface that two photographs confirm is in it


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Cubes of side `voxel` in the map's frame: x forward of the first camera, y to its left, z up (REP 103)."""

    states: npt.NDArray[np.uint8]  # (X, Y, Z) 0: not seen, 1: free, 2: occupied
    voxel: float  # side of a voxel, in the unit of the result
    origin: npt.NDArray[np.float64]  # (3,) least corner of voxel [0, 0, 0], map frame; whole numbers of voxels
    upright: Upright  # T_world_map, and how the direction of up is known
    scale: Scale = RELATIVE  # the unit of all lengths

    @property
    def T_world_map(self) -> npt.NDArray[np.float64]:
        """(4, 4): p_world = T_world_map @ p_map; the world is that of the result's cameras."""
        return self.upright.T_world_map.copy()

    @property
    def shares(self) -> dict[str, float]:
        """The share of all voxels in each state: `not_seen`, `free`, `occupied`."""
        counts = np.bincount(self.states.ravel(), minlength=len(VoxelState))
        return {state.name.lower(): float(counts[state] / self.states.size) for state in VoxelState}

    def at(self, points: npt.ArrayLike) -> npt.NDArray[np.uint8]:
        """(M,) the states at points (M, 3) of the result's world; NOT_SEEN outside the map.

        Raises ValueError for another shape.
        """
        world = np.asarray(points, np.float64)
        if world.ndim != 2 or world.shape[1] != 3:
            raise ValueError(f"points must be (M, 3), got {world.shape}")
        T = self.upright.T_world_map
        index = np.floor(((world - T[:3, 3]) @ T[:3, :3] - self.origin) / self.voxel)
        inside = np.isfinite(index).all(1) & (index >= 0).all(1) & (index < self.states.shape).all(1)
        found = np.full(len(world), VoxelState.NOT_SEEN, np.uint8)
        found[inside] = self.states[tuple(index[inside].astype(np.intp).T)]
        return found

    def save(self, folder: str | PathLike[str], band: Sequence[float] | None = None) -> list[Path]:
        """Writes occupancy.npz, occupancy.bt, collision.ply and collision.glb; returns what was written.

        With `band`, two heights in the map's frame, also map.pgm and map.yaml for nav2. Raises ValueError for a band
        that is none or that the map does not reach, ResultWriteError where nothing can be written.
        """
        from splatnode.recon.occupancy.files import save  # brings the formats

        return save(self, Path(folder), band)
