"""Where a thing stands: a frame of its own, on the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatnode.capture.diorama.builder import Vector, turn
from splatnode.capture.diorama.building.plan import Zone


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
