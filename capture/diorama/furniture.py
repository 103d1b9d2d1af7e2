"""Furniture that stands free: a table with things on it, a plant, a stack of cartons."""

from __future__ import annotations

import numpy as np

from splatnode.capture.diorama import prints
from splatnode.capture.diorama import textures as paint
from splatnode.capture.diorama.builder import INK, PAPER, Builder, Palette, Vector, scale_colour, turn
from splatnode.capture.diorama.solids import Shape


def table(builder: Builder, palette: Palette, x: float, y: float, yaw_deg: float) -> None:
    rng, accents = builder.rng, palette.accents
    turned = turn(yaw_deg)

    def place_point(dx: float, dy: float, z: float) -> Vector:
        px, py, _ = turned @ (dx, dy, 0.0)
        return x + px, y + py, z

    dark = paint.wood((128, 88, 60))
    builder.box(place_point(0, 0, 0.72), (1.1, 0.7, 0.04), paint.wood((168, 120, 80)), yaw_deg)
    for dx in (-0.48, 0.48):
        for dy in (-0.28, 0.28):
            builder.box(place_point(dx, dy, 0.35), (0.05, 0.05, 0.70), dark, yaw_deg)
    z = 0.74
    for width, depth, thickness in ((0.30, 0.22, 0.045), (0.27, 0.20, 0.035), (0.23, 0.17, 0.05)):
        colour = accents[int(rng.integers(len(accents)))]
        cover = prints.book(colour, PAPER if sum(colour) < 420 else INK)
        faces = [prints.pages, cover, prints.pages, cover, cover, cover]
        builder.box(
            place_point(-0.30, 0.10, z + thickness / 2),
            (width, depth, thickness),
            faces,
            yaw_deg + rng.uniform(-20, 20),
        )
        z += thickness
    mug = place_point(-0.28, 0.09, z)
    builder.cylinder(mug, 0.085, 0.10, paint.glaze(PAPER, accents[2]))
    stand = place_point(0.22, -0.12, 0.74)
    builder.cylinder(stand, 0.13, 0.03, dark)
    builder.ball((stand[0], stand[1], 0.77 + 0.14), 0.28, paint.globe((70, 120, 150), (176, 158, 96), PAPER), 23)
    builder.box(place_point(0.02, 0.20, 0.74 + 0.075), (0.11, 0.11, 0.15), prints.carton(accents[1], INK), yaw_deg + 30)
    builder.cylinder(place_point(0.38, 0.22, 0.74), 0.09, 0.17, paint.glaze(accents[3], PAPER))


def plant(builder: Builder, palette: Palette, x: float, y: float) -> None:
    rng = builder.rng
    builder.cylinder((x, y, 0), 0.34, 0.62, paint.marble((214, 206, 196), (120, 112, 116)))
    builder.cylinder((x, y, 0.62), 0.26, 0.24, paint.glaze((186, 104, 68), (226, 170, 124)))
    for index in range(22):
        azimuth, rise = index * 137.5, rng.uniform(20, 78)
        length = rng.uniform(0.26, 0.42)
        outward = turn(azimuth, -rise) @ (1.0, 0.0, 0.0)
        centre = np.array([x, y, 0.88]) + outward * length * 0.6
        green = scale_colour((82, 132, 66), rng.uniform(0.78, 1.22))
        size = (length, length * 0.30, 0.014)
        builder.add(Shape.ELLIPSOID, centre, size, paint.leaf(green), azimuth, -rise)


def cartons(builder: Builder, palette: Palette, x: float, y: float) -> None:
    rng = builder.rng
    brown = (190, 148, 102)
    builder.box((x, y, 0.22), (0.52, 0.46, 0.44), prints.carton(brown, INK), rng.uniform(-8, 12))
    yaw = rng.uniform(8, 30)
    builder.box(
        (x + 0.03, y - 0.02, 0.44 + 0.14), (0.36, 0.34, 0.28), prints.carton((206, 170, 122), (150, 44, 36)), yaw
    )
    along = (0.12, 0.47) if x < y else (0.52, 0.10)  # beside the stack, along its wall
    small = prints.carton(palette.accents[2], PAPER)
    builder.box((x + along[0], y + along[1], 0.13), (0.30, 0.30, 0.26), small, yaw + 20)
