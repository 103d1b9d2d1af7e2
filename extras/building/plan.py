"""The floor plan: a corridor along x, three rooms on each side of it, a door between each of them and the corridor.

World axes: z up, the floor at z = 0, the corridor's middle line in y = 0; metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatnode.capture.diorama.scene import Vector, turn

HEIGHT = 2.7  # of all ceilings
HALF_CORRIDOR = 1.15
WALL = 0.12  # between corridor and rooms
DOOR_WIDTH, DOOR_HEIGHT = 1.15, 2.1
ROOM = (5.2, 4.7)  # along x and y
LENGTH = 17.0  # of the corridor; the wall at its east end is blank
CORRIDOR = 6  # its number among the zones


@dataclass(frozen=True)
class Zone:
    """A room, or the corridor: its walls' inner faces."""

    number: int
    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def centre(self) -> tuple[float, float]:
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    def holds(self, x: float, y: float) -> bool:
        return self.x0 <= x <= self.x1 and self.y0 <= y <= self.y1


@dataclass(frozen=True)
class Door:
    """An opening between a room and the corridor, `x` its middle, y from `inner` (the corridor's side) to `outer`."""

    room: int
    x: float
    inner: float
    outer: float

    @property
    def side(self) -> float:
        """1 for a room in the north (y > 0), -1 for one in the south."""
        return 1.0 if self.outer > 0 else -1.0

    @property
    def span(self) -> tuple[float, float]:
        return self.x - DOOR_WIDTH / 2, self.x + DOOR_WIDTH / 2

    def holds(self, x: float, y: float) -> bool:
        """Whether a place is in the opening, between the two faces of its wall."""
        return abs(x - self.x) <= DOOR_WIDTH / 2 and min(self.inner, self.outer) < y < max(self.inner, self.outer)


def _zones() -> tuple[Zone, ...]:
    width, depth = ROOM
    near, far = HALF_CORRIDOR + WALL, HALF_CORRIDOR + WALL + depth
    columns = [(WALL + i * (width + WALL), WALL + i * (width + WALL) + width) for i in range(3)]
    north = [Zone(i, x0, near, x1, far) for i, (x0, x1) in enumerate(columns)]
    south = [Zone(i + 3, x0, -far, x1, -near) for i, (x0, x1) in enumerate(columns)]
    return *north, *south, Zone(CORRIDOR, 0.0, -HALF_CORRIDOR, LENGTH, HALF_CORRIDOR)


def _doors() -> tuple[Door, ...]:
    """One a room, in the order of the rooms; none lies opposite another, so that doors show walls with prints."""
    outer = HALF_CORRIDOR + WALL
    sides = [1.0] * 3 + [-1.0] * 3
    return tuple(
        Door(zone.number, zone.centre[0] - 1.05 * side, side * HALF_CORRIDOR, side * outer)
        for zone, side in zip(_zones(), sides, strict=False)
    )


ZONES = _zones()
DOORS = _doors()


def doors_of(zone: int) -> tuple[Door, ...]:
    return DOORS if zone == CORRIDOR else (DOORS[zone],)


def zones_at(x: float, y: float) -> tuple[int, ...]:
    """The zone that holds a place; of a place in a door both; the nearest one where no zone does."""
    for door in DOORS:
        if door.holds(x, y):
            return CORRIDOR, door.room
    inside = [zone.number for zone in ZONES if zone.holds(x, y)]
    return (inside[0],) if inside else (min(ZONES, key=lambda zone: _away(zone, x, y)).number,)


def _away(zone: Zone, x: float, y: float) -> float:
    return max(zone.x0 - x, x - zone.x1, 0.0) + max(zone.y0 - y, y - zone.y1, 0.0)


# Where a thing stands: a frame of its own, on the floor.


@dataclass(frozen=True)
class Spot:
    """A place on the floor: x along a wall, y away from it into the room, z up; turned by `yaw_deg` in the world."""

    x: float
    y: float
    yaw_deg: float

    def transform_point(self, dx: float, dy: float, z: float) -> Vector:
        """World coordinates of a point of this frame."""
        px, py, _ = turn(self.yaw_deg) @ np.array([dx, dy, 0.0])
        return self.x + float(px), self.y + float(py), z

    def offset_spot(self, dx: float, dy: float = 0.0, yaw_deg: float = 0.0) -> Spot:
        """Another place, by its coordinates in this frame."""
        x, y, _ = self.transform_point(dx, dy, 0.0)
        return Spot(x, y, self.yaw_deg + yaw_deg)


def walls(zone: Zone) -> dict[str, tuple[Spot, float]]:
    """Returns the foot of each wall's middle and the wall's length in metres, by side."""
    (x, y), width, depth = zone.centre, zone.x1 - zone.x0, zone.y1 - zone.y0
    return {
        "north": (Spot(x, zone.y1, 180.0), width),
        "east": (Spot(zone.x1, y, 90.0), depth),
        "south": (Spot(x, zone.y0, 0.0), width),
        "west": (Spot(zone.x0, y, -90.0), depth),
    }
