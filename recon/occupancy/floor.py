"""The floor: the lowest plane under the cameras that much of what was seen lies on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

TILT = 40.0  # degrees from what the cameras suggest, at most: their mean is off by as much as they look down
TILT_OF_GIVEN = 5.0  # degrees from a direction that was given
THICKNESS = 0.015  # of the distance: points that near to a plane are on it
LEAST_SHARE = 0.08  # of the surface that was seen
MOST_BELOW = 0.02  # of the surface that was seen may lie below the floor
LEAST_BELOW_CAMERAS = 0.1  # of the distance, by which every camera is above it
_TRIALS, _SAMPLE = 4000, 4000
_POLISHED = (1.0, 0.5, 0.5)  # of THICKNESS: what is so near to the plane found so far is what the next is fitted to


@dataclass(frozen=True, eq=False)
class Floor:
    """The plane normal @ p = offset; the normal is up."""

    normal: Array  # (3,)
    offset: float
    share: float  # of the surface that was seen

    def height(self, point: Array, up: Array) -> float:
        """How far above the floor a point (3,) is, along `up` (3,)."""
        return float((point @ self.normal - self.offset) / (up @ self.normal))


def find_floor(points: Array, centres: Array, up: Array, unit: float, tilt: float = TILT) -> Floor | None:
    """The floor among surface points (M, 3), `unit` being their median distance from the cameras at `centres` (C, 3).

    It is the plane with most points of those that are level to `tilt` degrees, by `up`, below all cameras, and have
    next to nothing below them. None where no plane is. The points are those of pixels: what is near counts for more.
    """
    rng = np.random.default_rng(0)
    sample = points if len(points) <= _SAMPLE else points[rng.choice(len(points), _SAMPLE, replace=False)]
    if len(sample) < 3:
        return None
    candidates = _planes(sample, rng, up, np.cos(np.radians(tilt)))
    judged = [_validate_floor(normal, offset, sample, centres, unit) for normal, offset in candidates]
    floors = [floor for floor in judged if floor is not None]
    return _refine_floor(max(floors, key=lambda floor: floor.share), sample, centres, unit) if floors else None


def _refine_floor(best: Floor, sample: Array, centres: Array, unit: float) -> Floor:
    """Fitted to all points that are near to it."""
    for part in _POLISHED:
        near = sample[np.abs(sample @ best.normal - best.offset) < part * THICKNESS * unit]
        middle = near.mean(0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal @ best.normal)
        best = _validate_floor(normal, float(middle @ normal), sample, centres, unit) or best
    return best


def _planes(points: Array, rng: np.random.Generator, up: Array, cosine: float) -> list[tuple[Array, float]]:
    """Planes through three of the points that are level, as upward normals and offsets."""
    a, b, c = points[rng.integers(len(points), size=(3, _TRIALS))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(lengths, 1e-30)[:, None]
    normals *= np.sign(normals @ up)[:, None]
    level = (normals @ up >= cosine) & (lengths > 0)
    return list(zip(normals[level], (a * normals).sum(1)[level].tolist(), strict=True))


def _validate_floor(normal: Array, offset: float, points: Array, centres: Array, unit: float) -> Floor | None:
    """The plane as a floor; None where it cannot be one."""
    if (centres @ normal - offset).min() < LEAST_BELOW_CAMERAS * unit:
        return None
    height = points @ normal - offset
    share, below = float((np.abs(height) < THICKNESS * unit).mean()), float((height < -3 * THICKNESS * unit).mean())
    return Floor(normal, offset, share) if share >= LEAST_SHARE and below <= MOST_BELOW else None
