"""Furniture that stands against a wall, or is carried about. Each piece is built in the frame of its Spot."""

from __future__ import annotations

from splatnode.capture.diorama import textures
from splatnode.capture.diorama.scene import CREAM, INK, PAPER, PLUS_Y, Builder, Palette, only, scale_colour
from splatnode.extras.building.plan import Spot

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
