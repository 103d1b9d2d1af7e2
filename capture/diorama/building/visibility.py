"""Which zones a camera can see: its own, and what lies behind the doors in its field of view."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.building.plan import CORRIDOR, Door, doors_of, zones_at
from splatnode.capture.diorama.cast import Camera, Matrix

ROLLED = 0.04  # of the slope, by which roll moves what is seen at the upper and lower rim
MARGIN = 1.15  # of the field of view: the camera is tilted and rolled a little
NEAR = 0.02  # metres; what of a door is closer to the camera's plane is cut off

Slopes = tuple[float, float]  # x / z of the leftmost and of the rightmost ray, in the camera's frame


def visible_zones(camera: Camera, width: int, behind: int | None = None) -> dict[int, slice]:
    """The zones that can be seen, by number, each with the image's columns in which it can be.

    `behind`: of a mirrored camera, the zone in which its rays begin.
    """
    T_world_camera, K = camera
    half = MARGIN * width / 2 / float(K[0, 0])
    x, y = T_world_camera[:2, 3]
    seen: dict[int, Slopes] = {}
    for zone in zones_at(float(x), float(y)) if behind is None else (behind,):
        _collect_zones(T_world_camera, zone, (-half, half), seen, None)
    return {zone: _columns(seen[zone], K, width) for zone in sorted(seen)}


def _columns(slopes: Slopes, K: Matrix, width: int) -> slice:
    """The columns of rays with such slopes, with a margin for the camera's tilt and roll."""
    low, high = (sign * (abs(slope) * (MARGIN - 1) + ROLLED) for sign, slope in zip((-1, 1), slopes, strict=True))
    ends = (K[0, 0] * (slope + wider) + K[0, 2] for slope, wider in zip(slopes, (low, high), strict=True))
    left, right = (int(np.clip(end, 0, width)) for end in ends)
    return slice(left, min(right + 1, width))


def find_visible_spheres(spheres: Matrix, camera: Camera, columns: slice, height: int) -> npt.NDArray[np.bool_]:
    """(S,) whether spheres (S, 4), centre and radius in the world, reach into so many rows and these columns."""
    T_world_camera, K = camera
    x, y, z = T_world_camera[:3, :3].T @ (spheres[:, :3] - T_world_camera[:3, 3]).T
    radius, inside = spheres[:, 3], z > -spheres[:, 3]
    bounds = (x, columns.start, columns.stop, K[0]), (y, 0, height, K[1])
    for along, first, last, row in bounds:
        focal, centre = row[row != 0][0], row[2]
        low, high = (first - centre) / focal, (last - centre) / focal
        inside &= along - low * z > -radius * np.hypot(1, low)
        inside &= along - high * z < radius * np.hypot(1, high)
    return inside


def _collect_zones(
    T_world_camera: Matrix, zone: int, slopes: Slopes, seen: dict[int, Slopes], through: Door | None
) -> None:
    known = seen.get(zone, slopes)
    seen[zone] = min(known[0], slopes[0]), max(known[1], slopes[1])
    for door in doors_of(zone):
        if door is through:
            continue
        narrowed = _clip_to_door(T_world_camera, door, zone, slopes)
        if narrowed is not None:
            _collect_zones(T_world_camera, door.room if zone == CORRIDOR else CORRIDOR, narrowed, seen, door)


def _clip_to_door(T_world_camera: Matrix, door: Door, zone: int, slopes: Slopes) -> Slopes | None:
    """The rays of `slopes` that pass a door from `zone`; None where there is none."""
    y = door.inner if zone == CORRIDOR else door.outer
    ends = np.array([[x, y] for x in door.span]) - T_world_camera[:2, 3]
    right, forward = T_world_camera[:2, 0], T_world_camera[:2, 2]
    right, forward = right / np.linalg.norm(right), forward / np.linalg.norm(forward)
    (x_a, z_a), (x_b, z_b) = ((float(end @ right), float(end @ forward)) for end in ends)
    if max(z_a, z_b) < NEAR:
        return None
    if min(z_a, z_b) < NEAR:
        share = (NEAR - z_a) / (z_b - z_a)
        cut = x_a + share * (x_b - x_a), NEAR
        (x_a, z_a), (x_b, z_b) = ((x_a, z_a), cut) if z_a > z_b else (cut, (x_b, z_b))
    low, high = sorted((x_a / z_a, x_b / z_b))
    low, high = max(low, slopes[0]), min(high, slopes[1])
    return (low, high) if low < high else None
