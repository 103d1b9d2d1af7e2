"""What a zone is enclosed by: floor, walls with the openings of its doors, casings, and a ceiling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from splatnode.capture.diorama import textures as paint
from splatnode.capture.diorama.builder import CREAM, PLUS_Y, PLUS_Z, Builder, only
from splatnode.capture.diorama.building.plan import CORRIDOR, DOOR_HEIGHT, HEIGHT, WALL, Zone, doors_of
from splatnode.capture.diorama.building.spot import Spot, walls

MINUS_Z = 4  # face of a box
CASING = 0.09  # metres, the width of the wood around a door


@dataclass(frozen=True)
class Cover:
    """The covering of walls and floor; `dado` is the lower metre of the walls, None for none."""

    wall: paint.Painter
    floor: paint.Painter
    dado: paint.Painter | None = None


def enclose(builder: Builder, zone: Zone, cover: Cover) -> None:
    """Floor and walls of a zone, and what its doors are lined with."""
    (x, y), size = zone.centre, (zone.x1 - zone.x0, zone.y1 - zone.y0)
    builder.box((x, y, -0.05), (*size, 0.1), only(PLUS_Z, cover.floor))
    for side, (spot, length) in walls(zone).items():
        _wall(builder, spot, length, openings(zone, side), cover)
    if zone.number != CORRIDOR:
        _lining(builder, zone)


def cover_above(builder: Builder, zone: Zone, painter: paint.Painter) -> None:
    """The ceiling."""
    faces = [painter if face == MINUS_Z else paint.blank for face in range(6)]
    builder.box((*zone.centre, HEIGHT + 0.05), (zone.x1 - zone.x0, zone.y1 - zone.y0, 0.1), faces)


def openings(zone: Zone, side: str) -> list[tuple[float, float]]:
    """The doors in a wall, as intervals of its x, from left to right as seen from the zone."""
    spot, _ = walls(zone)[side]
    towards = {"north": 1.0, "south": -1.0}.get(side)
    if zone.number != CORRIDOR and towards is not None:
        towards = -towards  # a room lies on the other side of its door
    found = [door.span for door in doors_of(zone.number) if door.side == towards]
    sign = -1.0 if side == "north" else 1.0
    return sorted((min(ends), max(ends)) for ends in ([sign * (x - spot.x) for x in span] for span in found))


def stretches(length: float, gaps: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Returns the parts of a wall between its gaps."""
    edges = [-length / 2, *(end for gap in gaps for end in gap), length / 2]
    return [(left, right) for left, right in zip(edges[::2], edges[1::2], strict=True) if right - left > 0.01]


def _wall(builder: Builder, spot: Spot, length: float, gaps: Sequence[tuple[float, float]], cover: Cover) -> None:
    skirting = only(PLUS_Y, paint.wood(CREAM), paint.plain(CREAM))
    for left, right in stretches(length, gaps):
        _panel(builder, spot, (left, right), (0.0, HEIGHT), cover.wall)
        middle, width = (left + right) / 2, right - left
        if cover.dado is not None:
            builder.box(
                spot.transform_point(middle, 0.008, 0.5), (width, 0.016, 1.0), only(PLUS_Y, cover.dado), spot.yaw_deg
            )
            builder.box(spot.transform_point(middle, 0.02, 1.0), (width, 0.04, 0.06), skirting, spot.yaw_deg)
        builder.box(spot.transform_point(middle, 0.012, 0.05), (width, 0.024, 0.10), skirting, spot.yaw_deg)
    for gap in gaps:
        _panel(builder, spot, gap, (DOOR_HEIGHT, HEIGHT), cover.wall)
        _casing(builder, spot, gap)


def _panel(
    builder: Builder, spot: Spot, along: tuple[float, float], up: tuple[float, float], painter: paint.Painter
) -> None:
    centre = spot.transform_point(sum(along) / 2, -WALL / 4, sum(up) / 2)
    builder.box(centre, (along[1] - along[0], WALL / 2, up[1] - up[0]), only(PLUS_Y, painter), spot.yaw_deg)


def _casing(builder: Builder, spot: Spot, gap: tuple[float, float]) -> None:
    wood = paint.wood((150, 108, 74))
    for x in (gap[0] - CASING / 2, gap[1] + CASING / 2):
        builder.box(spot.transform_point(x, 0.012, DOOR_HEIGHT / 2), (CASING, 0.036, DOOR_HEIGHT), wood, spot.yaw_deg)
    width = gap[1] - gap[0] + 2 * CASING
    builder.box(
        spot.transform_point(sum(gap) / 2, 0.014, DOOR_HEIGHT + CASING / 2), (width, 0.04, CASING), wood, spot.yaw_deg
    )


def _lining(builder: Builder, zone: Zone) -> None:
    """The inside of a room's door: jambs, head and threshold, as deep as the wall."""
    (door,) = doors_of(zone.number)
    y, wood = (door.inner + door.outer) / 2, paint.wood((168, 124, 84))
    depth = WALL + 0.002
    for x in (door.span[0] + 0.015, door.span[1] - 0.015):
        builder.box((x, y, DOOR_HEIGHT / 2), (0.03, depth, DOOR_HEIGHT), wood)
    builder.box((door.x, y, DOOR_HEIGHT - 0.015), (door.span[1] - door.span[0], depth, 0.03), wood)
    builder.box((door.x, y, -0.05), (door.span[1] - door.span[0], depth, 0.104), wood)
