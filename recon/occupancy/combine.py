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
        x, y, z = (np.round(base.origin / voxel).astype(np.int64) - start).tolist()
        a, b, c = base.states.shape
        states[x : x + a, y : y + b, z : z + c] = base.states
    return states, start, voxel


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
