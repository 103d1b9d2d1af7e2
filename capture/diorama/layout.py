"""The corner of a room: a brick wall, a painted wall, a wooden floor, and things at several depths in front of them.

World axes: z up, the corner at the origin, the brick wall in the plane x = 0, the painted wall in y = 0; metres.
"""

from __future__ import annotations

from functools import lru_cache

from splatnode.capture.diorama import prints
from splatnode.capture.diorama import textures as paint
from splatnode.capture.diorama.builder import (
    CREAM,
    INK,
    PALETTES,
    PAPER,
    PLUS_X,
    PLUS_Y,
    PLUS_Z,
    Builder,
    Palette,
    only,
    scale_colour,
)
from splatnode.capture.diorama.furniture import cartons, plant, table
from splatnode.capture.diorama.light import Light, bake_light
from splatnode.capture.diorama.solids import Solid

BRICK_WALL = 1  # its index among the solids of a place


@lru_cache(maxsize=4)
def place(seed: int, density: float) -> tuple[Solid, ...]:
    """The lit solids of a place; another seed is another place. `density`: texels per metre of the skins."""
    palette = PALETTES[seed % len(PALETTES)]
    builder = Builder(seed, density)
    rng = builder.rng
    _room(builder, palette)
    _furnish_walls(builder, palette)
    x, y = rng.uniform((0.85, 0.80), (1.05, 1.0))
    table(builder, palette, x, y, yaw_deg=rng.uniform(-12, 12))
    sides = rng.permutation([rng.uniform((1.95, 0.45), (2.25, 0.55)), rng.uniform((0.45, 1.95), (0.55, 2.25))])
    plant(builder, palette, *sides[0])
    cartons(builder, palette, *sides[1])
    _furnish_rug(builder, palette)
    height = rng.uniform(1.0, 1.3)
    towards_sun = rng.uniform(0.55, 0.8), rng.uniform(0.35, 0.6), height
    light = Light(towards_sun, texels_per_metre=density / 14)
    return tuple(bake_light(builder.solids, light, rng))


def _room(builder: Builder, palette: Palette) -> None:
    joint = (196, 188, 176)
    builder.box((2.4, 2.4, -0.1), (5.0, 5.0, 0.2), only(PLUS_Z, paint.planks(palette.floor)))
    builder.box((-0.1, 2.4, 1.6), (0.2, 5.0, 3.2), only(PLUS_X, paint.bricks(palette.brick, joint)))
    builder.box((2.5, -0.1, 1.6), (5.0, 0.2, 3.2), only(PLUS_Y, paint.plaster(palette.wall)))
    skirting = paint.wood(CREAM)
    builder.box((2.5, 0.012, 0.06), (5.0, 0.024, 0.12), skirting)
    builder.box((2.5, 0.02, 2.45), (5.0, 0.04, 0.07), skirting)


def _furnish_walls(builder: Builder, palette: Palette) -> None:
    rng, accents = builder.rng, palette.accents
    frame, paper = paint.wood((92, 66, 50)), paint.plain(PAPER)
    inks = [accents[1], accents[0], accents[3], accents[2], INK]
    for x, z, width, height in ((0.62, 1.62, 0.56, 0.78), (2.95, 1.55, 0.72, 1.0)):
        print_ = prints.poster(PAPER, [inks[i] for i in rng.permutation(4)] + [INK])
        builder.box((x, 0.012, z), (width + 0.05, 0.024, height + 0.05), frame)
        builder.box((x, 0.018, z), (width, 0.026, height), only(PLUS_Y, print_, paper))
    picture = prints.poster(CREAM, [inks[i] for i in rng.permutation(4)] + [INK])
    y = rng.uniform(1.15, 1.35)
    builder.box((0.015, y, 1.72), (0.03, 0.84, 0.62), frame)
    builder.box((0.021, y, 1.72), (0.034, 0.76, 0.54), only(PLUS_X, picture, paper))

    shelf_left, shelf_z = 1.18, rng.uniform(1.42, 1.5)
    builder.box((shelf_left + 0.6, 0.11, shelf_z), (1.2, 0.22, 0.03), paint.wood((120, 84, 58)))
    left = shelf_left + 0.05
    while left < shelf_left + 0.86:
        thickness, height = rng.uniform(0.028, 0.06), rng.uniform(0.20, 0.31)
        spine = accents[int(rng.integers(len(accents)))]
        cover = prints.book(scale_colour(spine, rng.uniform(0.75, 1.15)), PAPER if sum(spine) < 420 else INK)
        size = (thickness, 0.16, height)
        builder.box((left + thickness / 2, 0.10, shelf_z + 0.015 + height / 2), size, [cover] * 4 + [prints.pages] * 2)
        left += thickness + 0.003
    builder.ball((shelf_left + 1.03, 0.11, shelf_z + 0.105), 0.18, paint.marble(accents[0], CREAM))


def _furnish_rug(builder: Builder, palette: Palette) -> None:
    rng, accents = builder.rng, palette.accents
    builder.box((1.75, 1.75, 0.006), (1.7, 1.25, 0.012), paint.rug([CREAM, *accents]), -45 + rng.uniform(-8, 8))
    spots = rng.permutation([rng.uniform((1.25, 1.75), (1.4, 1.95)), rng.uniform((1.95, 1.2), (2.15, 1.35))])
    (ball_x, ball_y), (x, y) = spots
    builder.ball((ball_x, ball_y, 0.012 + 0.15), 0.30, paint.ball([accents[0], PAPER, accents[1]]), 35)
    builder.cylinder((x, y, 0.012), 0.36, 0.40, paint.glaze(accents[2], CREAM))
    for step in range(3):
        colour = accents[(step + 1) % len(accents)]
        cover = prints.book(colour, PAPER if sum(colour) < 420 else INK)
        size = (0.24, 0.18, 0.03)
        faces = [prints.pages, cover, prints.pages, cover, cover, cover]
        builder.box((x, y, 0.412 + 0.015 + 0.03 * step), size, faces, 120 + rng.uniform(-30, 30))
