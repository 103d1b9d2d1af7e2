"""What stands and hangs in each zone. Rooms 1 and 2 are look-alikes: the same paper and kinds of things, dealt anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama import textures
from splatnode.capture.diorama.render import Light, Solid, apply_irradiance, gather_irradiance, grid
from splatnode.capture.diorama.scene import (
    CREAM,
    INK,
    PALETTES,
    PAPER,
    PLUS_Y,
    PLUS_Z,
    Builder,
    Palette,
    cartons,
    only,
    plant,
    scale_colour,
    table,
)
from splatnode.extras.building import pieces
from splatnode.extras.building.plan import (
    CORRIDOR,
    DOOR_HEIGHT,
    HEIGHT,
    WALL,
    ZONES,
    Spot,
    Zone,
    doors_of,
    walls,
)

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
_TALL = (pieces.bookcase, pieces.rack)  # no print fits above them


@dataclass(frozen=True)
class Style:
    palette: Palette
    cover: Cover
    pieces: tuple[Piece, ...]  # seven, dealt to the walls
    centre: Piece


def _lying_bed(builder: Builder, palette: Palette, spot: Spot) -> None:
    pieces.single_bed(builder, palette, spot.offset_spot(-0.95, 0.68, -90.0))


def _arm_chair(builder: Builder, palette: Palette, spot: Spot) -> None:
    pieces.sofa(builder, palette, spot, width=0.85)


def _dining_table(builder: Builder, palette: Palette, spot: Spot) -> None:
    table(builder, palette, spot.x, spot.y, spot.yaw_deg)


def _stack(builder: Builder, palette: Palette, spot: Spot) -> None:
    cartons(builder, palette, spot.x, spot.y)


def _seat(builder: Builder, palette: Palette, spot: Spot) -> None:
    _arm_chair(builder, palette, spot.offset_spot(-0.2, -0.5))
    pieces.lamp(builder, palette, spot.offset_spot(0.55, -0.2))


def style(number: int) -> Style:
    """Returns the style of a room; the seed does not change it."""
    first, second, third, fourth = PALETTES
    case, side, sofa, desk, rack = pieces.bookcase, pieces.sideboard, pieces.sofa, pieces.desk, pieces.rack
    if number in LOOK_ALIKES:
        cover = Cover(textures.wallpaper(third.wall, [*third.accents, INK]), textures.planks(third.floor))
        return Style(third, cover, (sofa, _arm_chair, case, side, sofa, case, side), pieces.low_table)
    if number == 0:
        cover = Cover(
            textures.plaster(first.wall), textures.planks(first.floor), textures.drawers((176, 150, 120), 1, 24)
        )
        return Style(first, cover, (side, case, side, sofa, case, desk, side), _dining_table)
    if number == 4:
        cover = Cover(textures.wallpaper(second.wall, [second.accents[0], second.accents[2], INK]), _stone(second))
        return Style(second, cover, (desk, case, desk, case, side, rack, _arm_chair), pieces.low_table)
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
            pieces.picture(builder, palette, spot, 1.72, width, height)
    for side, x in _gaps(zone):
        spot = walls(zone)[side][0].offset_spot(x)
        pieces.picture(builder, palette, spot, rng.uniform(1.4, 1.6), rng.uniform(0.4, 0.5), rng.uniform(0.6, 0.8))
    spot = Spot(*zone.centre, rng.uniform(-25, 25))
    weave = textures.rug([CREAM, *(palette.accents[i] for i in rng.permutation(4))])
    builder.box(spot.transform_point(0, 0, 0.006), (2.3, 1.8, 0.012), weave, spot.yaw_deg)
    room.centre(builder, palette, spot)
    corners = [(zone.x0 + 0.35, zone.y1 - 0.35), (zone.x1 - 0.35, zone.y1 - 0.35)]
    corners = corners if zone.y0 > 0 else [(x, zone.y0 + 0.35) for x, _ in corners]
    first, second = (corners[i] for i in rng.permutation(2))
    plant(builder, palette, first[0], first[1])
    pieces.lamp(builder, palette, Spot(second[0], second[1], 0.0))
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
    pieces.sideboard(builder, palette, west)
    pieces.picture(builder, palette, west, 1.6, 1.1, 0.8)
    east, length = walls(zone)["east"]
    blank = textures.plain((216, 212, 204), 0.004)
    builder.box(east.transform_point(0, 0.03, HEIGHT / 2), (length, 0.06, HEIGHT), blank, east.yaw_deg)


def _line(builder: Builder, palette: Palette, spot: Spot, ends: tuple[float, float]) -> None:
    """Prints and now and then a piece of furniture along a stretch of the corridor's wall."""
    rng, x = builder.rng, ends[0] + 0.25
    furniture: Sequence[Piece] = (pieces.sideboard, pieces.lamp, _narrow_stack)
    while x < ends[1]:
        place = spot.offset_spot(x)
        pieces.picture(builder, palette, place, rng.uniform(1.5, 1.66), rng.uniform(0.45, 0.7), rng.uniform(0.5, 0.85))
        if rng.random() < 0.4 and ends[0] + 0.6 < x < ends[1] - 0.5:
            chosen = furniture[int(rng.integers(len(furniture)))]
            chosen(builder, palette, place if chosen is pieces.sideboard else place.offset_spot(0.42, 0.24))
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
        pieces.chair(builder, PALETTES[1], Spot(x + dx, y + dy, yaw_deg))
        found.append(builder.solids)
    return found
