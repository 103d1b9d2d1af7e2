"""What a camera in the building sees: colours and depth, with what the mirror reflects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.building.interior import interior
from splatnode.capture.diorama.building.rooms import CHAIR_ROOM, MIRROR_ROOM
from splatnode.capture.diorama.building.visibility import find_visible_spheres, visible_zones
from splatnode.capture.diorama.cast import Camera, colour_pixels, trace
from splatnode.capture.diorama.solids import Solid

SILVER = 0.93  # of the light that the mirror gives back


@dataclass(frozen=True)
class BuildingState:
    """A building at one moment."""

    seed: int
    density: float  # texels a metre
    chair: int  # where the chair stands


@dataclass(frozen=True)
class VisibleSolids:
    """The solids that may be seen, and each one's columns of the image; the mirror's index among them."""

    solids: list[Solid]
    columns: list[slice]
    mirror: int | None


def view(state: BuildingState, camera: Camera, width: int, height: int) -> npt.NDArray[np.float32]:
    """(H, W, 3) 8-bit colours."""
    sight = _collect_visible_solids(state, camera, width, height)
    z, nearest = trace(sight.solids, camera, width, height, columns=sight.columns)
    colours = colour_pixels(sight.solids, camera, z, nearest)
    if sight.mirror is not None and (nearest == sight.mirror).any():
        glass = np.where(nearest == sight.mirror, z, np.inf)
        _reflect(state, sight.solids[sight.mirror], camera, glass, colours)
    return colours


def depth(state: BuildingState, camera: Camera, width: int, height: int) -> npt.NDArray[np.float32]:
    """(H, W) z of the nearest surface in the camera's frame, metres; of the mirror, that of its glass."""
    sight = _collect_visible_solids(state, camera, width, height)
    return trace(sight.solids, camera, width, height, columns=sight.columns)[0]


def _collect_visible_solids(
    state: BuildingState, camera: Camera, width: int, height: int, behind: int | None = None
) -> VisibleSolids:
    """Collects the solids that `camera` may see; `behind`: the zone in which the rays of a mirrored camera begin."""
    solids: list[Solid] = []
    columns: list[slice] = []
    mirror = None
    for number, part in visible_zones(camera, width, behind).items():
        zone = interior(state.seed, state.density, number)
        near = find_visible_spheres(zone.spheres, camera, part, height)
        for index in np.flatnonzero(near):
            mirror = len(solids) if index == zone.mirror else mirror
            solids.append(zone.solids[index])
        solids += zone.chairs[state.chair] if number == CHAIR_ROOM else ()
        columns += [part] * (len(solids) - len(columns))
    return VisibleSolids(solids, columns, mirror)


def mirror_camera(mirror: Solid, camera: Camera) -> Camera:
    """The camera on the other side of the mirror's face; its frame is left-handed. A pixel's z stays the same."""
    T_world_camera, K = camera
    normal = mirror.axes[:, 1] / np.linalg.norm(mirror.axes[:, 1])
    turned = np.eye(4)
    turned[:3, :3] -= 2 * np.outer(normal, normal)
    turned[:3, 3] = 2 * (normal @ (mirror.centre + mirror.axes[:, 1])) * normal
    return turned @ T_world_camera, K


def _reflect(
    state: BuildingState,
    mirror: Solid,
    camera: Camera,
    glass: npt.NDArray[np.floating],
    colours: npt.NDArray[np.float32],
) -> None:
    """Paints what the mirror shows into `colours`, where `glass` (H, W), the mirror's z, is finite."""
    shown = np.isfinite(glass)
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    T_world_camera, K = mirror_camera(mirror, camera)
    shift = np.array([[1.0, 0.0, -columns[0]], [0.0, 1.0, -rows[0]], [0.0, 0.0, 1.0]])
    height, width = glass[part].shape
    virtual = T_world_camera, shift @ K
    solids = _collect_visible_solids(state, (T_world_camera, K), colours.shape[1], colours.shape[0], MIRROR_ROOM).solids
    z, nearest = trace(solids, virtual, width, height, glass[part] + 1e-3)
    reflected = colour_pixels(solids, virtual, z, nearest)
    inside = shown[part]
    colours[part][inside] = SILVER * reflected[inside]
