"""Collects the solids of a place, and paints them: what layouts and furniture are built with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatnode.capture.diorama import textures as paint
from splatnode.capture.diorama.solids import Shape, Solid, face_size

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
