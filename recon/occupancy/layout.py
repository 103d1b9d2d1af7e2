"""Layout: where the voxels of a map lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

PART_OF_DISTANCE = 64  # the default voxel is the median distance of what was seen, divided by this
MOST_VOXELS = 30_000_000  # a byte each, and as much again while they are carved
LONGEST_SIDE = 30_000  # voxels: OctoMap numbers 65536 along each axis, half of them on either side of 0
_OUTLIERS = 1.0  # per cent of the surface at either end of each axis that the map need not reach
_RIM = 2  # voxels around what was seen


@dataclass(frozen=True, eq=False)
class Layout:
    voxel: float
    first: npt.NDArray[np.int64]  # (3,) number of the first voxel along each axis; voxel 0 begins at the map's origin
    shape: tuple[int, int, int]

    @property
    def origin(self) -> Array:
        """(3,) least corner of the first voxel, map frame."""
        return self.first.astype(np.float64) * self.voxel


def choose_layout(points: Array, centres: Array, unit: float, metric: bool, voxel: float | None) -> Layout:
    """Voxels around surface points (M, 3) and cameras (C, 3) in the map's frame; `unit` is the median distance.

    Without a size `voxel`, it is chosen by the distance, and in metres made a round number. Raises ValueError for a
    size that is none, or of which there would be too many.
    """
    low, high = (np.percentile(points, percent, axis=0) for percent in (_OUTLIERS, 100.0 - _OUTLIERS))
    low, high = np.minimum(low, centres.min(0)), np.maximum(high, centres.max(0))
    if voxel is not None:
        voxel = float(voxel)  # files write it as Python does: NumPy's own numbers look otherwise
        if not (np.isfinite(voxel) and voxel > 0):
            raise ValueError(f"a voxel must have a side above 0, got {voxel!r}")
        if _count(low, high, voxel) > MOST_VOXELS or (high - low).max() / voxel > LONGEST_SIDE:
            least = _smallest_voxel(low, high, voxel)
            raise ValueError(
                f"the map would have more than {MOST_VOXELS} voxels of {voxel:g}; give a voxel of at least {least:.3g}"
            )
        return _create_layout(low, high, voxel)
    wanted = unit / PART_OF_DISTANCE
    return _create_layout(low, high, _smallest_voxel(low, high, _round(wanted) if metric else wanted))


def _create_layout(low: Array, high: Array, voxel: float) -> Layout:
    first = np.floor(low / voxel).astype(np.int64) - _RIM
    x, y, z = (np.ceil(high / voxel).astype(np.int64) + _RIM - first).tolist()
    return Layout(voxel, first, (x, y, z))


def _count(low: Array, high: Array, voxel: float) -> float:
    return float(np.prod((high - low) / voxel + 2 * _RIM + 2))


def _smallest_voxel(low: Array, high: Array, voxel: float) -> float:
    """The voxel, doubled until there are not too many."""
    while _count(low, high, voxel) > MOST_VOXELS or (high - low).max() / voxel > LONGEST_SIDE:
        voxel *= 2
    return voxel


def _round(metres: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `metres`, or hardly."""
    power = 10.0 ** np.floor(np.log10(metres))
    return float(max(step * power for step in (1, 2, 5) if step * power <= 1.01 * metres))
