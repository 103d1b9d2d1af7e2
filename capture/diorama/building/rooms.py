"""What stands and hangs in each zone. Rooms 1 and 2 are look-alikes: the same paper and kinds of things, dealt anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from splatnode.capture.diorama import papers, prints
from splatnode.capture.diorama import textures as paint
from splatnode.capture.diorama.builder import CREAM, INK, PALETTES, PAPER, Builder, Palette, scale_colour
from splatnode.capture.diorama.building import pieces
from splatnode.capture.diorama.building.plan import HEIGHT, Zone
from splatnode.capture.diorama.building.shell import Cover, openings, stretches
from splatnode.capture.diorama.building.spot import Spot, walls
from splatnode.capture.diorama.furniture import cartons, plant, table

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
        cover = Cover(papers.wallpaper(third.wall, [*third.accents, INK]), paint.planks(third.floor))
        return Style(third, cover, (sofa, _arm_chair, case, side, sofa, case, side), pieces.low_table)
    if number == 0:
        cover = Cover(paint.plaster(first.wall), paint.planks(first.floor), papers.drawers((176, 150, 120), 1, 24))
        return Style(first, cover, (side, case, side, sofa, case, desk, side), _dining_table)
    if number == 4:
        cover = Cover(papers.wallpaper(second.wall, [second.accents[0], second.accents[2], INK]), _stone(second))
        return Style(second, cover, (desk, case, desk, case, side, rack, _arm_chair), pieces.low_table)
    if number == 3:
        cover = Cover(paint.bricks(fourth.brick, (196, 188, 176)), _stone(fourth))
        return Style(fourth, cover, (rack, rack, desk, rack, side, rack, desk), _stack)
    cover = Cover(paint.plaster(fourth.wall), paint.planks((150, 112, 82)), papers.drawers((206, 190, 168), 1, 30))
    return Style(fourth, cover, (_lying_bed, side, case, _arm_chair, desk, side, case), _seat)


def corridor_cover() -> Cover:
    upper = papers.wallpaper((214, 206, 186), [(150, 120, 80), (90, 110, 120), (170, 90, 70)])
    return Cover(upper, paint.planks((168, 124, 92)), papers.drawers((150, 128, 104), 1, 14))


def _stone(palette: Palette) -> paint.Painter:
    return papers.tiles([scale_colour(palette.floor, factor) for factor in (0.9, 1.05, 1.2)] + [(196, 190, 180)])


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
    weave = paint.rug([CREAM, *(palette.accents[i] for i in rng.permutation(4))])
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
    frame = paint.wood((190, 150, 70))
    builder.box(spot.transform_point(0, 0.012, 1.2), (width + 0.1, 0.024, height + 0.1), frame, spot.yaw_deg)
    builder.box(spot.transform_point(0, 0.018, 1.2), (width, 0.03, height), paint.plain((200, 204, 206)), spot.yaw_deg)
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
    blank = paint.plain((216, 212, 204), 0.004)
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
            spot.transform_point(0, 0, z), (size, size, size), prints.carton(colour, PAPER if z > 0.3 else INK), turned
        )
