"""Collects the solids of a place, and paints them: what layouts and furniture are built with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.diorama import textures as paint
from splatnode.capture.diorama.render import Light, Shape, Solid, bake_light, face_size
from splatnode.capture.odometry import Gravity, Motion

TOWARDS_CAMERAS = 45.0  # yaw in degrees: round things turn the seam of their skin to the corner

PLUS_X, PLUS_Y, PLUS_Z = 1, 3, 5  # faces of a box

Vector = tuple[float, float, float]
Colours = Sequence[paint.Colour]


@dataclass(frozen=True)
class Palette:
    wall: paint.Colour
    brick: paint.Colour
    floor: paint.Colour
    accents: Colours


PALETTES = (
    Palette(
        (136, 172, 172), (158, 104, 84), (180, 132, 88), ((196, 62, 46), (238, 182, 64), (38, 84, 124), (60, 120, 92))
    ),
    Palette(
        (222, 186, 128), (150, 116, 100), (134, 98, 70), ((44, 94, 110), (214, 92, 52), (120, 52, 76), (232, 214, 170))
    ),
    Palette(
        (176, 186, 150), (186, 168, 146), (158, 108, 72), ((178, 58, 72), (52, 66, 104), (232, 158, 60), (84, 136, 128))
    ),
    Palette(
        (206, 170, 160), (128, 92, 84), (196, 156, 112), ((36, 92, 96), (226, 142, 60), (88, 70, 128), (196, 70, 78))
    ),
)
INK, PAPER, CREAM = (44, 42, 46), (240, 234, 220), (232, 220, 196)


class Builder:
    """Collects solids. Their positions come from `rng`; each face has random numbers of its own for its texture, so
    that a place has the same solids at every density."""

    def __init__(self, seed: int, density: float) -> None:
        self.seed, self.density = seed, density
        self.rng = np.random.default_rng(seed)
        self.solids: list[Solid] = []

    def add(
        self,
        shape: Shape,
        centre: Sequence[float] | np.ndarray,
        size: Sequence[float],
        painter: paint.Painter | Sequence[paint.Painter],
        yaw_deg: float = 0.0,
        tilt_deg: float = 0.0,
    ) -> None:
        """A solid of full `size`, tilted about its y axis, then turned by `yaw_deg` about the vertical."""
        axes = turn(yaw_deg, tilt_deg) * (np.array(size) / 2)
        painters = [painter] * shape.num_faces if callable(painter) else painter
        skins = tuple(
            face_painter(self._face_rng(face), *face_size(shape, axes, face), self.density)
            for face, face_painter in enumerate(painters)
        )
        self.solids.append(Solid(shape, axes, np.array(centre, float), skins))

    def _face_rng(self, face: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, len(self.solids), face])

    def box(self, centre: Sequence[float] | np.ndarray, size: Sequence[float], painter, yaw_deg: float = 0.0) -> None:
        self.add(Shape.BOX, centre, size, painter, yaw_deg)

    def ball(self, centre: Sequence[float] | np.ndarray, diameter: float, painter, tilt_deg: float = 0.0) -> None:
        self.add(Shape.ELLIPSOID, centre, (diameter,) * 3, painter, TOWARDS_CAMERAS, tilt_deg)

    def cylinder(self, foot: Sequence[float], diameter: float, height: float, painter) -> None:
        centre = (foot[0], foot[1], foot[2] + height / 2)
        self.add(Shape.CYLINDER, centre, (diameter, diameter, height), painter, TOWARDS_CAMERAS)


def scale_colour(colour: paint.Colour, factor: float) -> paint.Colour:
    red, green, blue = colour
    return red * factor, green * factor, blue * factor


def only(face: int, painter: paint.Painter, others: paint.Painter = paint.blank) -> list[paint.Painter]:
    """Painters of a box of which only one face matters."""
    return [painter if index == face else others for index in range(Shape.BOX.num_faces)]


def turn(yaw_deg: float, tilt_deg: float = 0.0) -> np.ndarray:
    """(3, 3) rotation: about y by `tilt_deg`, then about z by `yaw_deg`."""
    (cz, sz), (cy, sy) = ((np.cos(a), np.sin(a)) for a in np.radians([yaw_deg, tilt_deg]))
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])


# Furniture that stands free: a table with things on it, a plant, a stack of cartons.


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
        cover = paint.book(colour, PAPER if sum(colour) < 420 else INK)
        faces = [paint.pages, cover, paint.pages, cover, cover, cover]
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
    builder.box(place_point(0.02, 0.20, 0.74 + 0.075), (0.11, 0.11, 0.15), paint.carton(accents[1], INK), yaw_deg + 30)
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
    builder.box((x, y, 0.22), (0.52, 0.46, 0.44), paint.carton(brown, INK), rng.uniform(-8, 12))
    yaw = rng.uniform(8, 30)
    builder.box(
        (x + 0.03, y - 0.02, 0.44 + 0.14), (0.36, 0.34, 0.28), paint.carton((206, 170, 122), (150, 44, 36)), yaw
    )
    along = (0.12, 0.47) if x < y else (0.52, 0.10)  # beside the stack, along its wall
    small = paint.carton(palette.accents[2], PAPER)
    builder.box((x + along[0], y + along[1], 0.13), (0.30, 0.30, 0.26), small, yaw + 20)


# The corner of a room: a brick wall, a painted wall, a wooden floor, and things at several depths in front of them.
#
# World axes: z up, the corner at the origin, the brick wall in the plane x = 0, the painted wall in y = 0; metres.

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
        print_ = paint.poster(PAPER, [inks[i] for i in rng.permutation(4)] + [INK])
        builder.box((x, 0.012, z), (width + 0.05, 0.024, height + 0.05), frame)
        builder.box((x, 0.018, z), (width, 0.026, height), only(PLUS_Y, print_, paper))
    picture = paint.poster(CREAM, [inks[i] for i in rng.permutation(4)] + [INK])
    y = rng.uniform(1.15, 1.35)
    builder.box((0.015, y, 1.72), (0.03, 0.84, 0.62), frame)
    builder.box((0.021, y, 1.72), (0.034, 0.76, 0.54), only(PLUS_X, picture, paper))

    shelf_left, shelf_z = 1.18, rng.uniform(1.42, 1.5)
    builder.box((shelf_left + 0.6, 0.11, shelf_z), (1.2, 0.22, 0.03), paint.wood((120, 84, 58)))
    left = shelf_left + 0.05
    while left < shelf_left + 0.86:
        thickness, height = rng.uniform(0.028, 0.06), rng.uniform(0.20, 0.31)
        spine = accents[int(rng.integers(len(accents)))]
        cover = paint.book(scale_colour(spine, rng.uniform(0.75, 1.15)), PAPER if sum(spine) < 420 else INK)
        size = (thickness, 0.16, height)
        builder.box((left + thickness / 2, 0.10, shelf_z + 0.015 + height / 2), size, [cover] * 4 + [paint.pages] * 2)
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
        cover = paint.book(colour, PAPER if sum(colour) < 420 else INK)
        size = (0.24, 0.18, 0.03)
        faces = [paint.pages, cover, paint.pages, cover, cover, cover]
        builder.box((x, y, 0.412 + 0.015 + 0.03 * step), size, faces, 120 + rng.uniform(-30, 30))


# What wheels and an IMU of a camera in the built-in capture would say of its way: with errors, by chance.

Matrix = npt.NDArray[np.float64]

_LEAST_M, _LEAST_DEG = 1e-3, 0.05  # standard deviations that are told, however small the errors are
_DOWN = np.array([0.0, 0.0, -1.0])  # in the world of the built-in captures


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The motion that wheels and an IMU of a camera in the built-in capture would report, with errors by chance."""

    # Error of each step from a photograph to the next, as a share of its length (root mean square)
    drift: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.02
    noise_deg: Annotated[float, msgspec.Meta(ge=0, le=90)] = (
        2.0  # of each turn about each axis, and of gravity, degrees
    )


def odometry(names: Sequence[str], Ts: Sequence[Matrix], config: Config, seed: int) -> list[tuple[Motion, Gravity]]:
    """Simulates the odometry of frames with these names, taken from T_world_camera (4, 4) each.

    The standard deviations that are told are those of the errors.
    """
    rng = np.random.default_rng([seed, 2])
    found: list[tuple[Motion, Gravity]] = []
    for index, (name, T) in enumerate(zip(names, Ts, strict=True)):
        moved = _next(found[-1][0], np.linalg.inv(Ts[index - 1]) @ T, config, rng) if index else Motion(name)
        x, y, z = (_turn(config.noise_deg, rng) @ (T[:3, :3].T @ _DOWN)).tolist()
        found.append((moved, Gravity((x, y, z), max(config.noise_deg, _LEAST_DEG))))
    return found


def _next(motion: Motion, step: Matrix, config: Config, rng: np.random.Generator) -> Motion:
    measured = step.copy()
    sigma_m = config.drift / math.sqrt(3.0) * float(np.linalg.norm(step[:3, 3]))
    measured[:3, 3] += rng.normal(0.0, sigma_m, 3)
    measured[:3, :3] = step[:3, :3] @ _turn(config.noise_deg, rng)
    return motion.append_step(measured, max(sigma_m, _LEAST_M), max(config.noise_deg, _LEAST_DEG))


def _turn(noise_deg: float, rng: np.random.Generator) -> Matrix:
    return Rotation.from_rotvec(np.radians(rng.normal(0.0, noise_deg, 3))).as_matrix()
