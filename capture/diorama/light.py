"""Light baked into the skins: a low sun with soft shadows, and the sky as far as other solids leave it open.

All surfaces are Lambertian, so that a point has one colour from everywhere and the skin can hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.solids import Array, Solid, face_points, face_size, ray_interval


@dataclass(frozen=True)
class Light:
    towards_sun: tuple[float, float, float]
    texels_per_metre: float  # of the coarse grids on which the light is gathered
    sun: tuple[float, float, float] = (1.75, 1.6, 1.36)  # linear RGB irradiance
    sky: tuple[float, float, float] = (0.60, 0.63, 0.70)
    bounced: tuple[float, float, float] = (0.21, 0.18, 0.15)  # what arrives from other surfaces
    sun_radius: float = 0.035  # radians: how soft the shadows are
    sun_samples: int = 8
    sky_samples: int = 36


def bake_light(solids: Sequence[Solid], light: Light, rng: np.random.Generator) -> list[Solid]:
    """The solids with the light of their place multiplied into their skins."""
    return [replace(solid, skins=_bake_skins(solid, solids, light, rng)) for solid in solids]


def _bake_skins(solid: Solid, solids: Sequence[Solid], light: Light, rng: np.random.Generator):
    others = [other for other in solids if other is not solid]
    skins = []
    for face, skin in enumerate(solid.skins):
        if skin.shape[:2] == (1, 1):
            skins.append(skin)
            continue
        irradiance = _irradiance(solid, face, others, light, rng)
        skins.append(apply_irradiance(skin, irradiance))
    return tuple(skins)


def apply_irradiance(skin: npt.NDArray[np.uint8], irradiance: Array) -> npt.NDArray[np.uint8]:
    """A skin (h, w, 3) under the light of a coarser grid (m, n, 3), linear RGB."""
    smooth = cv2.resize(irradiance, (skin.shape[1], skin.shape[0]), interpolation=cv2.INTER_LINEAR)
    return encode_srgb(decode_srgb(skin) * smooth)


def _irradiance(solid: Solid, face: int, others: Sequence[Solid], light: Light, rng: np.random.Generator) -> Array:
    """(h, w, 3) linear RGB on a coarse grid of the face."""
    points, normals = grid(solid, face, light.texels_per_metre)
    shape = points.shape
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    in_front = [other for other in others if ((other.corners @ normals.T) > (points * normals).sum(1)).any()]
    irradiance = gather_irradiance(points, normals, in_front, light, rng)
    return cv2.GaussianBlur(irradiance.reshape(shape).astype(np.float32), (0, 0), 0.7).astype(np.float32)


def gather_irradiance(
    points: Array, normals: Array, occluders: Sequence[Solid], light: Light, rng: np.random.Generator
) -> Array:
    """(P, 3) linear RGB that arrives at points (P, 3) just above surfaces with unit normals (P, 3)."""
    towards_sun = np.array(light.towards_sun) / np.linalg.norm(light.towards_sun)
    to_sun = towards_sun + light.sun_radius * rng.normal(size=(len(points), light.sun_samples, 3)) / 1.7
    to_sky = _cosine_directions(normals, light.sky_samples, rng)
    is_open = _find_open_rays(points, np.concatenate([to_sun, to_sky], axis=1), occluders)
    sunlit = np.maximum(normals @ towards_sun, 0) * is_open[:, : light.sun_samples].mean(1)
    open_sky = is_open[:, light.sun_samples :].mean(1)[:, None]
    return sunlit[:, None] * light.sun + open_sky * light.sky + (1 - open_sky) * light.bounced


def grid(solid: Solid, face: int, texels_per_metre: float) -> tuple[Array, Array]:
    """Points (h, w, 3) just above a face, in the world, and their unit normals (h, w, 3)."""
    sides = face_size(solid.shape, solid.axes, face)
    columns, rows = (int(np.clip(np.ceil(side * texels_per_metre), 3, 130)) for side in sides)
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    points, normals = face_points(solid.shape, face, u, v)
    normals = normals @ solid.inverse  # a normal maps with the inverse transpose
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return points @ solid.axes.T + solid.centre + 1e-3 * normals, normals


def _cosine_directions(normals: Array, samples: int, rng: np.random.Generator) -> Array:
    """(P, samples, 3) directions, cosine-weighted about normals (P, 3): stratified rings, turned at random by point."""
    index = np.arange(samples) + 0.5
    radius = np.sqrt(index / samples)
    angle = index * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi, (len(normals), 1))
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    tangent = np.cross(normals, helper)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    basis = np.stack([tangent, np.cross(normals, tangent), normals], 1)  # (P, 3, 3) rows
    height = np.broadcast_to(np.sqrt(1 - radius**2), angle.shape)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1) @ basis


def _find_open_rays(points: Array, directions: Array, occluders: Sequence[Solid]) -> npt.NDArray[np.bool_]:
    """(P, S) whether a ray from points (P, 3) along directions (P, S, 3) meets no solid."""
    unblocked = np.ones(directions.shape[:2], bool)
    directions = directions.astype(np.float32)
    for solid in occluders:
        o = solid.transform_to_local(points).astype(np.float32)[:, None]
        d = directions @ solid.inverse.T.astype(np.float32)
        origin, direction = (o[..., 0], o[..., 1], o[..., 2]), (d[..., 0], d[..., 1], d[..., 2])
        near, far = ray_interval(solid.shape, origin, direction)
        unblocked &= ~((near <= far) & (far > 0))
    return unblocked


def decode_srgb(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """8-bit sRGB -> linear [0, 1]."""
    return _LINEAR[image]


def encode_srgb(linear: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Linear light -> 8-bit sRGB; highlights roll off towards white instead of clipping."""
    return _SRGB[np.minimum(linear * _STEPS_PER_UNIT, len(_SRGB) - 1).astype(np.int32)]


def _encoding_table(linear: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    rolled = np.where(linear > 0.6, 0.6 + 0.4 * np.tanh((linear - 0.6) / 0.4), linear)
    encoded = np.where(rolled <= 0.0031308, 12.92 * rolled, 1.055 * rolled ** (1 / 2.4) - 0.055)
    return np.rint(encoded * 255).astype(np.uint8)


_STEPS_PER_UNIT = 8192
_SRGB = _encoding_table(np.arange(3 * _STEPS_PER_UNIT) / _STEPS_PER_UNIT)
_CODES = np.arange(256) / 255
_LINEAR = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4).astype(np.float32)
