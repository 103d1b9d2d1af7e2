"""The light of a whole zone at once: one pass over the points of hundreds of small faces is quick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from splatnode.capture.diorama.light import Light, apply_irradiance, gather_irradiance, grid
from splatnode.capture.diorama.solids import Solid

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
