"""The lit solids of a zone, made when a camera first sees it and then kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama import papers
from splatnode.capture.diorama.builder import PALETTES, Builder
from splatnode.capture.diorama.building import pieces
from splatnode.capture.diorama.building.lighting import bake_zone_light
from splatnode.capture.diorama.building.plan import CORRIDOR, ZONES
from splatnode.capture.diorama.building.rooms import (
    CHAIR_ROOM,
    LOOK_ALIKES,
    corridor_cover,
    furnish,
    furnish_corridor,
    style,
)
from splatnode.capture.diorama.building.shell import cover_above, enclose
from splatnode.capture.diorama.building.spot import Spot
from splatnode.capture.diorama.light import Light
from splatnode.capture.diorama.solids import Solid

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
    cover_above(above, zone, papers.tiles([(186, 182, 172), (198, 194, 184)], 0.6))
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
