"""occupancy.npz: the map as NumPy arrays, which `numpy.load(..., allow_pickle=False)` reads."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.grid import OccupancyMap, VoxelState

AXES = "states[i, j, k] along x, y, z of the map: x forward of the first camera, y to its left, z up"
AXES_OF_RESULT = "states[i, j, k] along x, y, z of the map: x and y of the result's frame, z up"


def encode_npz(occupancy: OccupancyMap, further: Mapping[str, npt.NDArray] | None = None) -> bytes:
    """`states` (X, Y, Z) uint8, `origin` (3,), `voxel` (), `T_world_map` (4, 4), and texts that say what they mean.

    `further` are arrays beside these.
    """
    file = io.BytesIO()
    np.savez_compressed(
        file,
        states=occupancy.states,
        origin=occupancy.origin,
        voxel=np.float64(occupancy.voxel),
        T_world_map=occupancy.T_world_map,
        axes=np.array(AXES_OF_RESULT if occupancy.upright.is_of_result else AXES),
        meaning=np.array(", ".join(f"{state.value}: {state.name.lower()}" for state in VoxelState)),
        unit=np.array(occupancy.scale.unit),
        scale=np.array(occupancy.scale.sentence),
        world=np.array(occupancy.scale.frame.sentence),
        up=np.array(occupancy.upright.source),
        height=np.array(occupancy.upright.height),
        **(further or {}),  # pyright: ignore[reportArgumentType]
    )
    return file.getvalue()
