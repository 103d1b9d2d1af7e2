"""map.pgm and map.yaml: a band of heights, seen from above, as nav2's map_server and ROS 1's read it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.grid import OccupancyMap, VoxelState

# What map_saver writes. 205 is not seen only with a threshold of .196; of nav2's default, .25, it would be free.
_GREY = {VoxelState.NOT_SEEN: 205, VoxelState.FREE: 254, VoxelState.OCCUPIED: 0}
_FREE_BELOW, _OCCUPIED_ABOVE = 0.196, 0.65


def encode_nav2(occupancy: OccupancyMap, band: Sequence[float], relative: bool = False) -> dict[str, bytes]:
    """map.pgm and map.yaml of the voxels that reach into the band of heights (low, high) in the map's frame.

    A cell is occupied where any of these voxels is, free where all of them are. Raises ValueError for a band that is
    none, or that the map does not reach, and, unless `relative`, for a map without metres: nav2 takes every length for
    metres.
    """
    if not (occupancy.scale.metric or relative):
        raise ValueError(
            "a map for nav2 must be in metres, which nav2 takes every length for; this result is "
            f"{occupancy.scale.sentence}. Reconstruct with something that gives metres, as --marker 100mm or --poses "
            "FILE, leave out --band for the other files, or ask for a map without a unit: --relative"
        )
    cells = project_band(occupancy, band)
    x, y = occupancy.origin[:2].tolist()
    low, high = band
    yaml = (
        f"# seen from above: heights {low:g} to {high:g}, {occupancy.scale.sentence}\n"
        f"# unit: {occupancy.scale.unit}\n"
        f"# {occupancy.upright.height}\n"
        f"# {_describe_axes(occupancy)}\n"
        "image: map.pgm\n"
        "mode: trinary\n"
        f"resolution: {occupancy.voxel!r}\n"
        f"origin: [{x!r}, {y!r}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {_OCCUPIED_ABOVE}\n"
        f"free_thresh: {_FREE_BELOW}\n"
    )
    grey = np.vectorize(_GREY.__getitem__, otypes=[np.uint8])(cells)
    rows = np.ascontiguousarray(grey.T[::-1])  # the first row is that of the largest y
    stated = f"# splatnode: unit {occupancy.scale.unit}, {occupancy.voxel!r} a pixel\n"
    header = f"P5\n{stated}{rows.shape[1]} {rows.shape[0]}\n255\n"
    return {"map.pgm": header.encode() + rows.tobytes(), "map.yaml": yaml.encode()}


def _describe_axes(occupancy: OccupancyMap) -> str:
    """Says what the origin is in."""
    if occupancy.upright.is_of_result:
        return f"x and y are of the result's frame: {occupancy.scale.frame.name.value}"
    return "x is forward of the first camera, y to its left"


def project_band(occupancy: OccupancyMap, band: Sequence[float]) -> npt.NDArray[np.uint8]:
    """(X, Y) the states of a band of heights, as `encode_nav2` has them. Raises ValueError."""
    if len(band) != 2 or not all(math.isfinite(height) for height in band) or not band[0] < band[1]:
        raise ValueError(f"a band must be two heights, the lower one first, got {list(band)}")
    bottom, voxel, layers = float(occupancy.origin[2]), occupancy.voxel, occupancy.states.shape[2]
    first, last = (round((band[0] - bottom) / voxel, 6), round((band[1] - bottom) / voxel, 6))
    if first < 0 or last > layers:
        raise ValueError(
            f"the map reaches from {bottom:.3g} to {bottom + layers * voxel:.3g}; the band {band[0]:g} to {band[1]:g} "
            "is not within"
        )
    part = occupancy.states[:, :, math.floor(first) : math.ceil(last)]
    free, occupied = (part == VoxelState.FREE).all(2), (part == VoxelState.OCCUPIED).any(2)
    return np.select([occupied, free], [VoxelState.OCCUPIED, VoxelState.FREE], VoxelState.NOT_SEEN).astype(np.uint8)
