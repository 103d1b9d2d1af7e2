"""The surface of the occupied voxels, as triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.grid import OccupancyMap, VoxelState

# A face's corners, as steps from the voxel's least corner, anticlockwise from outside; by axis, for the far side
_FAR_FACES = np.array(
    [
        [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]],
        [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]],
        [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    ]
)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, anticlockwise from outside, in the map's frame."""

    vertices: npt.NDArray[np.float32]  # (V, 3)
    triangles: npt.NDArray[np.uint32]  # (T, 3)


def surface_mesh(occupancy: OccupancyMap) -> Mesh:
    """The sides of occupied voxels that another state, or the map's end, lies at; what nobody saw has no surface."""
    occupied = np.pad(occupancy.states == VoxelState.OCCUPIED, 1)
    corners = [_corners(occupied, axis, sign) for axis in range(3) for sign in (-1, 1)]
    quads = np.concatenate(corners)  # (Q, 4, 3)
    numbers = np.array(occupied.shape) + 1
    flat = np.ravel_multi_index(tuple(quads.reshape(-1, 3).T), tuple(numbers)) if len(quads) else np.zeros(0, np.int64)
    used, index = np.unique(flat, return_inverse=True)
    vertices = np.stack(np.unravel_index(used, tuple(numbers)), 1) - 1  # without the padding
    first, second, third, fourth = index.reshape(-1, 4).T
    triangles = np.stack([first, second, third, first, third, fourth], 1).reshape(-1, 3)
    return Mesh(
        (occupancy.origin + vertices * occupancy.voxel).astype(np.float32),
        triangles.astype(np.uint32),
    )


def _corners(occupied: npt.NDArray[np.bool_], axis: int, sign: int) -> npt.NDArray[np.int64]:
    """(Q, 4, 3) corners of the faces on one side of the voxels."""
    voxels = np.argwhere(occupied & ~np.roll(occupied, -sign, axis))
    face = _FAR_FACES[axis]
    if sign < 0:
        face = face[::-1] * (np.arange(3) != axis)
    return voxels[:, None] + face
