"""One map of several scenes: their maps, each in a frame of its own, brought into that of the first.

What is called free stays free only where a part says so of a whole neighbourhood: the parts lie to each other as their
links tell, and no voxel of one is a voxel of another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.grid import LONGEST_SIDE, MOST_VOXELS, OccupancyMap, VoxelState, ignore_cancel
from splatnode.recon.result.placement import Placement

Array = npt.NDArray[np.float64]

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

    def to_all(self, points: Array) -> Array:
        """The points (M, 3) of this map's frame in the world of all."""
        T = self.occupancy.T_world_map
        return self.placement.transform_points(points @ T[:3, :3].T + T[:3, 3])

    def to_own(self, points: Array) -> Array:
        """The points (M, 3) of the world of all in this map's frame."""
        T = self.occupancy.T_world_map
        return (self.placement.inverse().transform_points(points) - T[:3, 3]) @ T[:3, :3]


def combine_maps(parts: Sequence[PlacedMap], pause: Callable[[], None] = ignore_cancel) -> OccupancyMap:
    """The map of all parts, in the frame of the first and in the unit that the placements lead to.

    A voxel is occupied where any part has a surface, free where a part knows all of it and MARGIN beside it as free,
    and no other has a surface there. Voxels are as large as the largest of the parts, and larger where there would be
    too many. `pause` is called between parts, and may raise. Raises ValueError without a part.
    """
    if not parts:
        raise ValueError("a map of several scenes needs at least one, got none")
    first = parts[0]
    T = np.eye(4)
    T[:3, :3] = first.placement.rotation @ first.occupancy.T_world_map[:3, :3]
    T[:3, 3] = first.to_all(np.zeros((1, 3)))[0]
    corners = [_find_known_corners(part) for part in parts]
    known = [(points - T[:3, 3]) @ T[:3, :3] for points in corners]
    low, high = np.concatenate(known).min(0), np.concatenate(known).max(0)
    voxel = max(part.voxel for part in parts)
    while np.prod((high - low) / voxel + 3) > MOST_VOXELS or (high - low).max() / voxel > LONGEST_SIDE:
        voxel *= 2
    start = np.floor(low / voxel).astype(np.int64) - 1
    shape = np.ceil(high / voxel).astype(np.int64) + 1 - start
    states = np.zeros(tuple(shape.tolist()), np.uint8)
    for part, points in zip(parts, known, strict=True):
        pause()
        for index in _list_voxels(points, start, voxel, states.shape):
            states[tuple(index[_is_free(part, index, start, voxel, T)].T)] = VoxelState.FREE
    for part in parts:
        pause()
        index = np.floor(((_spread_occupied(part) - T[:3, 3]) @ T[:3, :3]) / voxel).astype(np.int64) - start
        inside = ((index >= 0) & (index < states.shape)).all(1)
        states[tuple(index[inside].T)] = VoxelState.OCCUPIED
    frame = replace(first.occupancy.upright, T_world_map=T)
    return OccupancyMap(states, voxel, start * voxel, frame, first.occupancy.scale)


def _find_known_corners(part: PlacedMap) -> Array:
    """(8, 3) the corners, in the world of all, of the box around what the part knows; of all where that is none."""
    known = np.argwhere(part.occupancy.states != VoxelState.NOT_SEEN)
    low, high = (known.min(0), known.max(0) + 1) if len(known) else (np.zeros(3), np.array(part.occupancy.states.shape))
    box = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    return part.to_all(part.occupancy.origin + box * part.occupancy.voxel)


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
        own = part.to_own(points @ T[:3, :3].T + T[:3, 3])
        own_index = np.floor((own - part.occupancy.origin) / part.occupancy.voxel).astype(np.int64)
        inside = ((own_index >= 0) & (own_index < part.occupancy.states.shape)).all(1)
        found = np.zeros(len(points), bool)
        found[inside] = part.occupancy.states[tuple(own_index[inside].T)] == VoxelState.FREE
        free[free] = found
    return free


def _spread_occupied(part: PlacedMap) -> Array:
    """(M, 3) points in the world of all, 125 of each occupied voxel, evenly spread."""
    index = np.argwhere(part.occupancy.states == VoxelState.OCCUPIED)
    points = (index[:, None] + 0.5 + _DENSE).reshape(-1, 3)
    return part.to_all(part.occupancy.origin + points * part.occupancy.voxel)
