"""The building that the building camera walks through: its floor plan, and what stands and hangs in each zone.

A corridor lies along x, three rooms on each side of it, a door between each of them and the corridor. World axes: z up,
the floor at z = 0, the corridor's middle line in y = 0; metres. Rooms 1 and 2 are look-alikes: the same paper and kinds
of things, dealt anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture import textures
from splatnode.capture.diorama import (
    CREAM,
    INK,
    PALETTES,
    PAPER,
    PLUS_Y,
    PLUS_Z,
    Builder,
    Light,
    Palette,
    Solid,
    Vector,
    apply_irradiance,
    cartons,
    gather_irradiance,
    grid,
    only,
    plant,
    scale_colour,
    table,
    turn,
)

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


DARK, OAK = (112, 78, 54), (176, 130, 86)


def picture(builder: Builder, palette: Palette, spot: Spot, z: float, width: float, height: float) -> None:
    """A framed print at height `z` (its middle), flat on the wall."""
    rng, accents = builder.rng, palette.accents
    inks = [*accents, INK]
    printed = textures.poster if rng.random() < 0.5 else textures.abstract
    print_ = printed(PAPER if rng.random() < 0.6 else CREAM, [inks[i] for i in rng.permutation(4)] + [INK])
    frame = textures.wood(scale_colour(DARK, rng.uniform(0.6, 1.6)))
    builder.box(spot.transform_point(0, 0.012, z), (width + 0.06, 0.024, height + 0.06), frame, spot.yaw_deg)
    builder.box(spot.transform_point(0, 0.018, z), (width, 0.026, height), only(PLUS_Y, print_), spot.yaw_deg)


def bookcase(builder: Builder, palette: Palette, spot: Spot) -> None:
    """1.1 m wide, .32 deep, 1.9 high; four rows of books."""
    rng, wood = builder.rng, textures.wood(DARK)
    builder.box(spot.transform_point(0, 0.01, 0.95), (1.1, 0.02, 1.9), only(PLUS_Y, wood), spot.yaw_deg)
    for x in (-0.535, 0.535):
        builder.box(spot.transform_point(x, 0.16, 0.95), (0.03, 0.32, 1.9), wood, spot.yaw_deg)
    for level in range(5):
        z = 0.08 + 0.45 * level
        builder.box(spot.transform_point(0, 0.16, z), (1.04, 0.31, 0.03), wood, spot.yaw_deg)
        if level < 4:
            width, depth = rng.uniform(0.7, 1.02), rng.uniform(0.17, 0.27)
            x = rng.uniform(-1, 1) * (1.03 - width) / 2
            faces = only(PLUS_Y, textures.book_row(palette.accents, (PAPER, INK)), textures.plain((70, 58, 52)))
            builder.box(spot.transform_point(x, depth / 2, z + 0.19), (width, depth, 0.35), faces, spot.yaw_deg)


def sideboard(builder: Builder, palette: Palette, spot: Spot) -> None:
    """1.4 m wide, .42 deep, .76 high, with things on it."""
    rng, accents = builder.rng, palette.accents
    front = only(PLUS_Y, textures.drawers(OAK, 3, int(rng.integers(2, 5))), textures.wood(OAK))
    builder.box(spot.transform_point(0, 0.21, 0.38), (1.4, 0.42, 0.76), front, spot.yaw_deg)
    ball, *rest = rng.permutation([-0.52, -0.15, 0.2, 0.55])
    builder.ball(spot.transform_point(ball, 0.2, 0.76 + 0.11), 0.22, textures.marble(accents[0], CREAM))
    builder.cylinder(
        spot.transform_point(rest[0], 0.22, 0.76), 0.13, rng.uniform(0.2, 0.34), textures.glaze(accents[3], PAPER)
    )
    box = textures.carton(scale_colour(accents[1], 1.05), INK)
    builder.box(
        spot.transform_point(rest[1], 0.2, 0.76 + 0.09), (0.22, 0.2, 0.18), box, spot.yaw_deg + rng.uniform(-30, 30)
    )
    _books(builder, palette, spot.offset_spot(rest[2], 0.22), 0.76)


def sofa(builder: Builder, palette: Palette, spot: Spot, width: float = 1.75) -> None:
    """.8 m deep; a narrow one is an arm chair."""
    rng, accents = builder.rng, palette.accents
    cloth = textures.upholstery(scale_colour(accents[2], 1.1), [CREAM, accents[1], INK])
    builder.box(spot.transform_point(0, 0.42, 0.21), (width, 0.76, 0.42), cloth, spot.yaw_deg)
    builder.box(spot.transform_point(0, 0.14, 0.45), (width, 0.2, 0.86), cloth, spot.yaw_deg)
    for x in (-width / 2, width / 2):
        builder.box(spot.transform_point(x, 0.42, 0.3), (0.18, 0.78, 0.6), cloth, spot.yaw_deg)
    for x in (-0.5, 0.05, 0.5) if width > 1.2 else (0.0,):
        size, cushion = rng.uniform(0.34, 0.44), textures.rug([CREAM, *(accents[i] for i in rng.permutation(4))])
        turned = spot.yaw_deg + rng.uniform(-18, 18)
        builder.box(
            spot.transform_point(x, rng.uniform(0.33, 0.45), 0.42 + size / 2), (size, 0.14, size), cushion, turned
        )


def desk(builder: Builder, palette: Palette, spot: Spot) -> None:
    """1.4 m wide, .65 deep: a monitor, books, a mug, a carton below."""
    rng, accents, oak = builder.rng, palette.accents, textures.wood(OAK)
    builder.box(spot.transform_point(0, 0.33, 0.73), (1.4, 0.65, 0.04), oak, spot.yaw_deg)
    for x in (-0.66, 0.66):
        builder.box(spot.transform_point(x, 0.33, 0.355), (0.04, 0.6, 0.71), oak, spot.yaw_deg)
    x = rng.uniform(-0.25, 0.25)
    builder.box(spot.transform_point(x, 0.2, 0.77), (0.24, 0.18, 0.04), textures.plain(INK), spot.yaw_deg)
    faces = only(PLUS_Y, textures.screen(INK), textures.plain((60, 60, 64)))
    builder.box(spot.transform_point(x, 0.19, 1.03), (0.62, 0.05, 0.40), faces, spot.yaw_deg + rng.uniform(-14, 14))
    _books(builder, palette, spot.offset_spot(-0.52, 0.3), 0.75)
    builder.cylinder(spot.transform_point(0.5, 0.42, 0.75), 0.085, 0.11, textures.glaze(PAPER, accents[2]))
    builder.box(
        spot.transform_point(0.3, 0.3, 0.2), (0.4, 0.34, 0.4), textures.carton((190, 148, 102), INK), spot.yaw_deg + 12
    )


def single_bed(builder: Builder, palette: Palette, spot: Spot) -> None:
    """1.3 m wide, 1.9 m into the room."""
    rng, accents = builder.rng, palette.accents
    builder.box(spot.transform_point(0, 0.03, 0.5), (1.36, 0.06, 1.0), textures.wood(DARK), spot.yaw_deg)
    builder.box(spot.transform_point(0, 0.98, 0.17), (1.3, 1.86, 0.34), textures.wood(OAK), spot.yaw_deg)
    quilt = textures.rug([CREAM, accents[0], accents[3], accents[1]])
    builder.box(spot.transform_point(0, 1.15, 0.42), (1.34, 1.5, 0.18), quilt, spot.yaw_deg)
    for x in (-0.33, 0.33):
        pillow = textures.upholstery(CREAM, [accents[2], accents[0]])
        builder.box(spot.transform_point(x, 0.24, 0.44), (0.55, 0.34, 0.2), pillow, spot.yaw_deg + rng.uniform(-10, 10))


def rack(builder: Builder, palette: Palette, spot: Spot) -> None:
    """An open rack, 1.4 m wide, .45 deep, 1.8 high, with cartons and pots."""
    rng, accents = builder.rng, palette.accents
    steel = textures.plain((120, 124, 130), 0.10)
    for x in (-0.68, 0.68):
        for y in (0.03, 0.42):
            builder.box(spot.transform_point(x, y, 0.9), (0.04, 0.04, 1.8), steel, spot.yaw_deg)
    for level in range(3):
        z = 0.12 + 0.62 * level
        builder.box(spot.transform_point(0, 0.225, z), (1.4, 0.45, 0.03), textures.wood(OAK), spot.yaw_deg)
        for x in (-0.45, 0.0, 0.45):
            width, depth, height = rng.uniform((0.26, 0.24, 0.2), (0.4, 0.4, 0.44))
            centre, turned = spot.transform_point(x, 0.22, z + 0.015 + height / 2), spot.yaw_deg + rng.uniform(-14, 14)
            if rng.random() < 0.25:
                builder.cylinder(
                    spot.transform_point(x, 0.22, z + 0.015), width * 0.8, height, textures.glaze(accents[2], PAPER)
                )
            else:
                colour = scale_colour((196, 154, 106), rng.uniform(0.8, 1.15)) if rng.random() < 0.6 else accents[1]
                builder.box(centre, (width, depth, height), textures.carton(colour, INK), turned)


def lamp(builder: Builder, palette: Palette, spot: Spot) -> None:
    """A standard lamp, 1.65 m high."""
    builder.cylinder(spot.transform_point(0, 0, 0.0), 0.28, 0.04, textures.wood(DARK))
    builder.cylinder(spot.transform_point(0, 0, 0.04), 0.05, 1.26, textures.wood(DARK))
    shade = textures.upholstery(CREAM, [palette.accents[1], palette.accents[0]])
    builder.cylinder(spot.transform_point(0, 0, 1.28), 0.42, 0.36, shade)


def chair(builder: Builder, palette: Palette, spot: Spot) -> None:
    """A wooden chair; it faces along the spot's y."""
    wood, seat = textures.wood((148, 92, 58)), textures.upholstery(palette.accents[0], [CREAM, palette.accents[1]])
    builder.box(spot.transform_point(0, 0, 0.45), (0.44, 0.44, 0.06), seat, spot.yaw_deg)
    for x in (-0.19, 0.19):
        builder.box(spot.transform_point(x, 0.19, 0.21), (0.045, 0.045, 0.42), wood, spot.yaw_deg)
        builder.box(spot.transform_point(x, -0.19, 0.47), (0.045, 0.045, 0.94), wood, spot.yaw_deg)
    for z in (0.62, 0.78, 0.9):
        builder.box(spot.transform_point(0, -0.19, z), (0.4, 0.03, 0.08), seat if z > 0.7 else wood, spot.yaw_deg)


def low_table(builder: Builder, palette: Palette, spot: Spot) -> None:
    """.9 m by .6, .42 high, with books, a globe and a pot."""
    rng, accents = builder.rng, palette.accents
    builder.box(spot.transform_point(0, 0, 0.4), (0.9, 0.6, 0.04), textures.wood(OAK), spot.yaw_deg)
    for x, y in ((-0.4, -0.25), (-0.4, 0.25), (0.4, -0.25), (0.4, 0.25)):
        builder.box(spot.transform_point(x, y, 0.19), (0.05, 0.05, 0.38), textures.wood(DARK), spot.yaw_deg)
    _books(builder, palette, spot.offset_spot(-0.22, rng.uniform(-0.1, 0.1)), 0.42)
    builder.ball(
        spot.transform_point(0.2, 0.1, 0.42 + 0.13), 0.26, textures.globe((70, 120, 150), (176, 158, 96), PAPER), 23
    )
    builder.cylinder(spot.transform_point(0.1, -0.17, 0.42), 0.11, 0.2, textures.glaze(accents[3], PAPER))


def _books(builder: Builder, palette: Palette, spot: Spot, z: float) -> None:
    """Three books, one on the other, the lowest at height `z`."""
    rng = builder.rng
    for width, depth, thickness in ((0.28, 0.21, 0.045), (0.25, 0.18, 0.035), (0.21, 0.16, 0.05)):
        colour = palette.accents[int(rng.integers(4))]
        cover = textures.book(colour, PAPER if sum(colour) < 420 else INK)
        faces = [textures.pages, cover, textures.pages, cover, cover, cover]
        centre = spot.transform_point(0, 0, z + thickness / 2)
        builder.box(centre, (width, depth, thickness), faces, spot.yaw_deg + rng.uniform(-20, 20))
        z += thickness


# What a zone is enclosed by: floor, walls with the openings of its doors, casings, and a ceiling.

MINUS_Z = 4  # face of a box
CASING = 0.09  # metres, the width of the wood around a door


@dataclass(frozen=True)
class Cover:
    """The covering of walls and floor; `dado` is the lower metre of the walls, None for none."""

    wall: textures.Painter
    floor: textures.Painter
    dado: textures.Painter | None = None


def enclose(builder: Builder, zone: Zone, cover: Cover) -> None:
    """Floor and walls of a zone, and what its doors are lined with."""
    (x, y), size = zone.centre, (zone.x1 - zone.x0, zone.y1 - zone.y0)
    builder.box((x, y, -0.05), (*size, 0.1), only(PLUS_Z, cover.floor))
    for side, (spot, length) in walls(zone).items():
        _wall(builder, spot, length, openings(zone, side), cover)
    if zone.number != CORRIDOR:
        _lining(builder, zone)


def cover_above(builder: Builder, zone: Zone, painter: textures.Painter) -> None:
    """The ceiling."""
    faces = [painter if face == MINUS_Z else textures.blank for face in range(6)]
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
    skirting = only(PLUS_Y, textures.wood(CREAM), textures.plain(CREAM))
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
    builder: Builder, spot: Spot, along: tuple[float, float], up: tuple[float, float], painter: textures.Painter
) -> None:
    centre = spot.transform_point(sum(along) / 2, -WALL / 4, sum(up) / 2)
    builder.box(centre, (along[1] - along[0], WALL / 2, up[1] - up[0]), only(PLUS_Y, painter), spot.yaw_deg)


def _casing(builder: Builder, spot: Spot, gap: tuple[float, float]) -> None:
    wood = textures.wood((150, 108, 74))
    for x in (gap[0] - CASING / 2, gap[1] + CASING / 2):
        builder.box(spot.transform_point(x, 0.012, DOOR_HEIGHT / 2), (CASING, 0.036, DOOR_HEIGHT), wood, spot.yaw_deg)
    width = gap[1] - gap[0] + 2 * CASING
    builder.box(
        spot.transform_point(sum(gap) / 2, 0.014, DOOR_HEIGHT + CASING / 2), (width, 0.04, CASING), wood, spot.yaw_deg
    )


def _lining(builder: Builder, zone: Zone) -> None:
    """The inside of a room's door: jambs, head and threshold, as deep as the wall."""
    (door,) = doors_of(zone.number)
    y, wood = (door.inner + door.outer) / 2, textures.wood((168, 124, 84))
    depth = WALL + 0.002
    for x in (door.span[0] + 0.015, door.span[1] - 0.015):
        builder.box((x, y, DOOR_HEIGHT / 2), (0.03, depth, DOOR_HEIGHT), wood)
    builder.box((door.x, y, DOOR_HEIGHT - 0.015), (door.span[1] - door.span[0], depth, 0.03), wood)
    builder.box((door.x, y, -0.05), (door.span[1] - door.span[0], depth, 0.104), wood)


Piece = Callable[[Builder, Palette, Spot], None]
LOOK_ALIKES = (1, 2)
CHAIR_ROOM, MIRROR_ROOM = 0, 4
MIRROR_SIZE = (1.3, 1.5)  # metres, width and height
_TALL = (bookcase, rack)  # no print fits above them


@dataclass(frozen=True)
class Style:
    palette: Palette
    cover: Cover
    pieces: tuple[Piece, ...]  # seven, dealt to the walls
    centre: Piece


def _lying_bed(builder: Builder, palette: Palette, spot: Spot) -> None:
    single_bed(builder, palette, spot.offset_spot(-0.95, 0.68, -90.0))


def _arm_chair(builder: Builder, palette: Palette, spot: Spot) -> None:
    sofa(builder, palette, spot, width=0.85)


def _dining_table(builder: Builder, palette: Palette, spot: Spot) -> None:
    table(builder, palette, spot.x, spot.y, spot.yaw_deg)


def _stack(builder: Builder, palette: Palette, spot: Spot) -> None:
    cartons(builder, palette, spot.x, spot.y)


def _seat(builder: Builder, palette: Palette, spot: Spot) -> None:
    _arm_chair(builder, palette, spot.offset_spot(-0.2, -0.5))
    lamp(builder, palette, spot.offset_spot(0.55, -0.2))


def style(number: int) -> Style:
    """Returns the style of a room; the seed does not change it."""
    first, second, third, fourth = PALETTES
    case, side = bookcase, sideboard
    if number in LOOK_ALIKES:
        cover = Cover(textures.wallpaper(third.wall, [*third.accents, INK]), textures.planks(third.floor))
        return Style(third, cover, (sofa, _arm_chair, case, side, sofa, case, side), low_table)
    if number == 0:
        cover = Cover(
            textures.plaster(first.wall), textures.planks(first.floor), textures.drawers((176, 150, 120), 1, 24)
        )
        return Style(first, cover, (side, case, side, sofa, case, desk, side), _dining_table)
    if number == 4:
        cover = Cover(textures.wallpaper(second.wall, [second.accents[0], second.accents[2], INK]), _stone(second))
        return Style(second, cover, (desk, case, desk, case, side, rack, _arm_chair), low_table)
    if number == 3:
        cover = Cover(textures.bricks(fourth.brick, (196, 188, 176)), _stone(fourth))
        return Style(fourth, cover, (rack, rack, desk, rack, side, rack, desk), _stack)
    cover = Cover(
        textures.plaster(fourth.wall), textures.planks((150, 112, 82)), textures.drawers((206, 190, 168), 1, 30)
    )
    return Style(fourth, cover, (_lying_bed, side, case, _arm_chair, desk, side, case), _seat)


def corridor_cover() -> Cover:
    upper = textures.wallpaper((214, 206, 186), [(150, 120, 80), (90, 110, 120), (170, 90, 70)])
    return Cover(upper, textures.planks((168, 124, 92)), textures.drawers((150, 128, 104), 1, 14))


def _stone(palette: Palette) -> textures.Painter:
    return textures.tiles([scale_colour(palette.floor, factor) for factor in (0.9, 1.05, 1.2)] + [(196, 190, 180)])


def furnish(builder: Builder, zone: Zone, room: Style) -> int | None:
    """Deals the pieces to the walls, with prints above and between; the index of the mirror among the solids."""
    rng, palette, mirror = builder.rng, room.palette, None
    slots = _slots(zone)
    dealt = [room.pieces[i] for i in rng.permutation(len(room.pieces))]
    for number, (piece, (side, x)) in enumerate(zip(dealt, slots, strict=True)):
        spot = walls(zone)[side][0].offset_spot(x + rng.uniform(-0.08, 0.08))
        if zone.number == MIRROR_ROOM and number == 0:
            mirror = _mirror(builder, spot)
            continue
        piece(builder, palette, spot)
        if piece not in _TALL:
            width, height = rng.uniform((0.55, 0.5), (0.8, 0.66))
            picture(builder, palette, spot, 1.72, width, height)
    for side, x in _gaps(zone):
        spot = walls(zone)[side][0].offset_spot(x)
        picture(builder, palette, spot, rng.uniform(1.4, 1.6), rng.uniform(0.4, 0.5), rng.uniform(0.6, 0.8))
    spot = Spot(*zone.centre, rng.uniform(-25, 25))
    weave = textures.rug([CREAM, *(palette.accents[i] for i in rng.permutation(4))])
    builder.box(spot.transform_point(0, 0, 0.006), (2.3, 1.8, 0.012), weave, spot.yaw_deg)
    room.centre(builder, palette, spot)
    corners = [(zone.x0 + 0.35, zone.y1 - 0.35), (zone.x1 - 0.35, zone.y1 - 0.35)]
    corners = corners if zone.y0 > 0 else [(x, zone.y0 + 0.35) for x, _ in corners]
    first, second = (corners[i] for i in rng.permutation(2))
    plant(builder, palette, first[0], first[1])
    lamp(builder, palette, Spot(second[0], second[1], 0.0))
    return mirror


def _slots(zone: Zone) -> list[tuple[str, float]]:
    """(wall, x along it) of the seven pieces: two at each wall, one beside the door."""
    far, near = ("north", "south") if zone.y0 > 0 else ("south", "north")
    (gap,) = openings(zone, near)
    left, right = max(stretches(walls(zone)[near][1], [gap]), key=lambda part: part[1] - part[0])
    beside = (left + right) / 2 + (0.15 if right > -left else -0.15)
    return [("west", -1.15), ("west", 1.15), (far, -1.2), (far, 1.2), ("east", -1.15), ("east", 1.15), (near, beside)]


def _gaps(zone: Zone) -> list[tuple[str, float]]:
    far = "north" if zone.y0 > 0 else "south"
    return [("west", 0.0), (far, 0.0), ("east", 0.0)]


def _mirror(builder: Builder, spot: Spot) -> int:
    """Hangs the mirror, whose face is that along the spot's y; its index among the solids."""
    width, height = MIRROR_SIZE
    frame = textures.wood((190, 150, 70))
    builder.box(spot.transform_point(0, 0.012, 1.2), (width + 0.1, 0.024, height + 0.1), frame, spot.yaw_deg)
    builder.box(
        spot.transform_point(0, 0.018, 1.2), (width, 0.03, height), textures.plain((200, 204, 206)), spot.yaw_deg
    )
    return len(builder.solids) - 1


def furnish_corridor(builder: Builder, zone: Zone) -> None:
    """Prints between the doors, a few pieces, a west end to recognise, and an east end that is blank."""
    palette = PALETTES[1]
    for side in ("north", "south"):
        spot, length = walls(zone)[side]
        for left, right in stretches(length, openings(zone, side)):
            _line(builder, palette, spot, (left + 0.35, right - 0.35))
    west = walls(zone)["west"][0]
    sideboard(builder, palette, west)
    picture(builder, palette, west, 1.6, 1.1, 0.8)
    east, length = walls(zone)["east"]
    blank = textures.plain((216, 212, 204), 0.004)
    builder.box(east.transform_point(0, 0.03, HEIGHT / 2), (length, 0.06, HEIGHT), blank, east.yaw_deg)


def _line(builder: Builder, palette: Palette, spot: Spot, ends: tuple[float, float]) -> None:
    """Prints and now and then a piece of furniture along a stretch of the corridor's wall."""
    rng, x = builder.rng, ends[0] + 0.25
    furniture: Sequence[Piece] = (sideboard, lamp, _narrow_stack)
    while x < ends[1]:
        place = spot.offset_spot(x)
        picture(builder, palette, place, rng.uniform(1.5, 1.66), rng.uniform(0.45, 0.7), rng.uniform(0.5, 0.85))
        if rng.random() < 0.4 and ends[0] + 0.6 < x < ends[1] - 0.5:
            chosen = furniture[int(rng.integers(len(furniture)))]
            chosen(builder, palette, place if chosen is sideboard else place.offset_spot(0.42, 0.24))
        x += rng.uniform(0.85, 1.15)


def _narrow_stack(builder: Builder, palette: Palette, spot: Spot) -> None:
    rng = builder.rng
    for z, size in ((0.18, 0.36), (0.5, 0.28)):
        colour = palette.accents[int(rng.integers(4))] if z > 0.3 else (196, 154, 106)
        turned = spot.yaw_deg + rng.uniform(-20, 20)
        builder.box(
            spot.transform_point(0, 0, z),
            (size, size, size),
            textures.carton(colour, PAPER if z > 0.3 else INK),
            turned,
        )


# The light of a whole zone at once: one pass over the points of hundreds of small faces is quick.

SHADOW_FROM = 0.3  # metres: what is shorter on all sides casts no shadow


def bake_zone_light(
    solids: Sequence[Solid], among: Sequence[Solid], light: Light, rng: np.random.Generator
) -> tuple[Solid, ...]:
    """The solids with the light multiplied into their skins; those of `among` cast shadows, on themselves none."""
    faces = [(solid, face) for solid in solids for face, skin in enumerate(solid.skins) if skin.shape[:2] != (1, 1)]
    grids = [grid(solid, face, light.texels_per_metre) for solid, face in faces]
    points, normals = (np.concatenate([each[part].reshape(-1, 3) for each in grids]) for part in (0, 1))
    occluders = [solid for solid in among if 2 * np.linalg.norm(solid.axes, axis=0).max() > SHADOW_FROM]
    irradiance = gather_irradiance(points, normals, occluders, light, rng).astype(np.float32)
    skins, first = {id(solid): list(solid.skins) for solid in solids}, 0
    for (solid, face), (on_face, _) in zip(faces, grids, strict=True):
        count = on_face.shape[0] * on_face.shape[1]
        arrived = cv2.GaussianBlur(irradiance[first : first + count].reshape(on_face.shape), (0, 0), 0.7).astype(
            np.float32
        )
        skins[id(solid)][face] = apply_irradiance(solid.skins[face], arrived)
        first += count
    return tuple(replace(solid, skins=tuple(skins[id(solid)])) for solid in solids)


# The lit solids of a zone, made when a camera first sees it and then kept.

CHAIR_PLACES = ((0.15, 0.72, 200.0), (-0.95, -0.15, -70.0))  # from the room's centre: x, y, yaw in degrees


@dataclass(frozen=True, eq=False)
class Interior:
    solids: tuple[Solid, ...]
    mirror: int | None  # the index of the solid whose face along its y axis reflects
    chairs: tuple[tuple[Solid, ...], ...]  # the chair's solids by where it stands; empty where there is none

    @cached_property
    def spheres(self) -> npt.NDArray[np.float64]:  # (S, 4) around the solids: centre and radius, world
        radii = [np.linalg.norm(solid.corners - solid.centre, axis=1).max() for solid in self.solids]
        return np.concatenate([[solid.centre for solid in self.solids], np.array(radii)[:, None]], 1)


@lru_cache(maxsize=16)
def interior(seed: int, density: float, number: int) -> Interior:
    """Builds the interior of the zone `number`, with `density` texels a metre."""
    zone = ZONES[number]
    paper_seed = 100 * seed + (LOOK_ALIKES[0] if number in LOOK_ALIKES else number)
    shell = Builder(paper_seed, density)  # look-alikes have the same paper, leaf by leaf
    inside = Builder(100 * seed + 10 + number, density)
    if number == CORRIDOR:
        enclose(shell, zone, corridor_cover())
        furnish_corridor(inside, zone)
        mirror = None
    else:
        enclose(shell, zone, style(number).cover)
        mirror = furnish(inside, zone, style(number))
    solids = [*shell.solids, *inside.solids]
    above = Builder(100 * seed + 20 + number, density)
    cover_above(above, zone, textures.tiles([(186, 182, 172), (198, 194, 184)], 0.6))
    rng = np.random.default_rng([seed, 30, number])
    light = Light((0.5, 0.35, 1.5), texels_per_metre=min(6.0, density / 16), sun_samples=3, sky_samples=12)
    chairs = tuple(bake_zone_light(chair, [*solids, *chair], light, rng) for chair in _chairs(seed, density, number))
    index = None if mirror is None else len(shell.solids) + mirror
    return Interior((*bake_zone_light(solids, solids, light, rng), *above.solids), index, chairs)


def _chairs(seed: int, density: float, number: int) -> list[list[Solid]]:
    if number != CHAIR_ROOM:
        return []
    x, y = ZONES[number].centre
    found = []
    for dx, dy, yaw_deg in CHAIR_PLACES:
        builder = Builder(100 * seed + 40, density)
        chair(builder, PALETTES[1], Spot(x + dx, y + dy, yaw_deg))
        found.append(builder.solids)
    return found
