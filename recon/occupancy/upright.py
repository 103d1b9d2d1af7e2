"""Upright: the map's frame, whose z axis is up, by the best that tells where up is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.floor import TILT, TILT_OF_GIVEN, Floor, find_floor

Array = npt.NDArray[np.float64]
_LEVEL = 3.0  # times as far as along up the cameras' right axes must spread, to tell where up is


@dataclass(frozen=True, eq=False)
class Upright:
    """x forward of the first camera and y to its left, both level; z up, 0 on the floor, if one was found."""

    T_world_map: Array  # (4, 4)
    source: str  # of the direction of up, in words
    on_floor: bool  # z = 0 is the floor; else it is the height of the first camera

    @property
    def height(self) -> str:
        """Says what heights count from."""
        return "z = 0 is the floor" if self.on_floor else "no floor was found: z = 0 is the height of the first camera"


def upright(
    Ts_world_camera: Sequence[Array], points: Array, given: Array | None, unit: float, source: str = "given"
) -> Upright:
    """The frame of a map of surface points (M, 3) that cameras (4, 4) saw from a median distance `unit`.

    `given` (3,) is the direction of up in the world, if gravity or a tracker tells it, as `source` says. Else it is
    the normal of the floor, and without one what keeps the cameras level. Raises ValueError where `given` is no
    direction.
    """
    Ts = np.stack(Ts_world_camera)
    guess, how = level(Ts)
    if given is not None:
        guess, how = _unit(given), source
    floor = find_floor(points, Ts[:, :3, 3], guess, unit, TILT if given is None else TILT_OF_GIVEN)
    if floor is not None and given is None:
        guess, how = floor.normal, f"the floor, a plane through {100 * floor.share:.0f} % of the surface that was seen"
    return Upright(_frame(Ts[0], guess, floor), how, floor is not None)


def level(Ts_world_camera: Array) -> tuple[Array, str]:
    """(3,) the direction of up that the cameras (C, 4, 4) suggest, and how.

    Cameras are seldom rolled: up is at right angles to their x axes. Where these are all alike, it is the mean of
    the cameras' own up, which is off by as much as they look down.
    """
    mean = _unit(-Ts_world_camera[:, :3, 1].mean(0))
    _, spread, axes = np.linalg.svd(Ts_world_camera[:, :3, 0])
    if len(Ts_world_camera) >= 3 and spread[1] > _LEVEL * spread[2]:
        return axes[2] * np.sign(axes[2] @ mean or 1.0), "the cameras, taken as not rolled in the mean"
    return mean, "the mean up of the cameras"


def _unit(direction: Array) -> Array:
    length = float(np.linalg.norm(direction))
    if np.shape(direction) != (3,) or not np.isfinite(length) or length < 1e-9:
        raise ValueError(f"up must be a direction (3,), not zero, got {np.asarray(direction).tolist()}")
    return np.asarray(direction, np.float64) / length


def _frame(first: Array, up: Array, floor: Floor | None) -> Array:
    """(4, 4) below the first camera on the floor, or at it where there is no floor."""
    forward = first[:3, 2] - (first[:3, 2] @ up) * up
    if np.linalg.norm(forward) < 1e-3:  # it looks straight up or down
        forward = -first[:3, 1] - (-first[:3, 1] @ up) * up
    x = _unit(forward)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(up, x), up], 1)
    height = 0.0 if floor is None else floor.height(first[:3, 3], up)
    T[:3, 3] = first[:3, 3] - height * up
    return T
