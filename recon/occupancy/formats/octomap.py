"""occupancy.bt: OctoMap's binary tree (Hornung et al., OctoMap, 2013), for octomap_server, MoveIt and octovis.

A text header, then every inner node from the root on, in depth-first order: two bytes with two bits for each of its
eight children, 0 not known, 1 free, 2 occupied, 3 a node with children. Child 0 is the least along x, y and z; x
counts 1, y 2, z 4. The tree has 16 levels; its middle is the map's origin. Eight children alike are one leaf.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.grid import OccupancyMap

LEVELS = 16
_MIDDLE = 1 << (LEVELS - 1)
_MIXED = 3
_EVERY_THIRD = np.arange(LEVELS, dtype=np.uint64)


class _Level(NamedTuple):
    """The nodes of one level in a box: `codes` (X, Y, Z) as in the file, and the number (3,) of the first of them."""

    codes: npt.NDArray[np.uint8]
    first: npt.NDArray[np.int64]


def encode_octomap(occupancy: OccupancyMap) -> bytes:
    """The file's bytes. Its frame is the map's, its unit that of the result."""
    level = _Level(occupancy.states, np.rint(occupancy.origin / occupancy.voxel).astype(np.int64) + _MIDDLE)
    words, paths, heights = [], [], []
    count = 1  # the root
    for height in range(1, LEVELS + 1):
        children, first = _children(level)
        level = _Level(_parents(children), first)
        inner = np.argwhere(level.codes == _MIXED) if height < LEVELS else np.zeros((1, 3), np.int64)
        bits = children[tuple(inner.T)].astype(np.uint32)
        words.append((bits << (2 * np.arange(8, dtype=np.uint32))).sum(1).astype("<u2"))
        paths.append(_interleave_bits(inner + first) << np.uint64(3 * height))
        heights.append(np.full(len(inner), height))
        count += int((bits > 0).sum())
    order = np.lexsort([-np.concatenate(heights), np.concatenate(paths)])
    head = f"# Octomap OcTree binary file\n# unit: {occupancy.scale.unit}\n"  # OctoMap skips further comments
    header = f"{head}id OcTree\nsize {count}\nres {occupancy.voxel!r}\ndata\n"
    return header.encode() + np.concatenate(words)[order].tobytes()


def _children(level: _Level) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """(X', Y', Z', 8) the codes of the children of each node of the next level, and the number (3,) of the first."""
    before = level.first % 2
    after = (level.first + level.codes.shape) % 2
    even = np.pad(level.codes, list(zip(before, after, strict=True)))
    x, y, z = (side // 2 for side in even.shape)
    eight = even.reshape(x, 2, y, 2, z, 2).transpose(0, 2, 4, 5, 3, 1).reshape(x, y, z, 8)
    return eight, level.first // 2


def _parents(children: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(X, Y, Z) the code of each node: that of its children where all have the same, else _MIXED."""
    first = children[..., 0]
    return np.where((children == first[..., None]).all(-1), first, np.uint8(_MIXED))


def _interleave_bits(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.uint64]:
    """(M,) the bits of numbers (M, 3) in turn, x the lowest: nodes in this order are in that of their paths."""
    bits = (numbers[:, :, None].astype(np.uint64) >> _EVERY_THIRD) & np.uint64(1)
    return (bits << (3 * _EVERY_THIRD + np.arange(3, dtype=np.uint64)[:, None])).sum((1, 2), dtype=np.uint64)
