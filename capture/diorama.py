"""The place that the synthetic camera photographs: solids, their textures, their light and their layout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property, lru_cache, reduce
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture import textures as paint
from splatnode.capture.frame import Gravity, Intrinsics, Motion
from splatnode.capture.lenses import unproject

# Boxes, ellipsoids and cylinders, and where rays meet them.
#
# A solid is a unit shape (box [-1, 1]^3, ball of radius 1, cylinder of radius 1 and z in [-1, 1]) under an affine map.
# Rays are mapped into the unit shape's frame, which leaves the ray parameter t as it is, and every shape is an
# intersection of slabs and round tubes, so that a ray's stay in it is an intersection of intervals of t.

Array = npt.NDArray[np.floating]
Vectors = Sequence[Array | np.floating]  # x, y, z of many points or directions, of shapes that broadcast


class Shape(Enum):
    BOX = 6  # faces -x +x -y +y -z +z
    ELLIPSOID = 1
    CYLINDER = 3  # side, bottom, top

    @property
    def num_faces(self) -> int:
        return self.value


@dataclass(frozen=True, eq=False)
class Solid:
    shape: Shape
    axes: npt.NDArray[np.float64]  # (3, 3) columns: the unit shape's axes in the world, as long as its half size
    centre: npt.NDArray[np.float64]  # (3,) world
    skins: tuple[npt.NDArray[np.uint8], ...]  # (h, w, 3) RGB by face, seen from outside; (1, 1, 3) where never seen

    @cached_property
    def inverse(self) -> Array:  # (3, 3) world directions -> the unit shape's frame
        return np.linalg.inv(self.axes)

    @cached_property
    def corners(self) -> npt.NDArray[np.float64]:  # (8, 3) world, of the parallelepiped around the solid
        signs = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij"), -1).reshape(8, 3)
        return signs @ self.axes.T + self.centre

    def transform_to_local(self, points: Array) -> Array:
        """(..., 3) world -> (..., 3) in the unit shape's frame."""
        return (points - self.centre) @ self.inverse.T


def ray_interval(shape: Shape, origin: Vectors, direction: Vectors) -> tuple[Array, Array]:
    """(near, far): a ray, in the unit shape's frame, is inside for t in [near, far]; near > far where it misses."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape is Shape.BOX:
            parts = [_slab(o, d) for o, d in zip(origin, direction, strict=True)]
        elif shape is Shape.ELLIPSOID:
            parts = [_tube(origin, direction)]
        else:
            parts = [_tube(origin[:2], direction[:2]), _slab(origin[2], direction[2])]
    return reduce(np.maximum, (near for near, _ in parts)), reduce(np.minimum, (far for _, far in parts))


def _slab(origin: Array | np.floating, direction: Array | np.floating) -> tuple[Array, Array]:
    """-1 <= coordinate <= 1."""
    a, b = (-1 - origin) / direction, (1 - origin) / direction
    return np.minimum(a, b), np.maximum(a, b)


def _tube(origin: Vectors, direction: Vectors) -> tuple[Array, Array]:
    """Distance from the origin, or in two coordinates from the axis, at most 1."""
    a = sum(d * d for d in direction)
    b = sum(o * d for o, d in zip(origin, direction, strict=True))
    c = sum(o * o for o in origin) - 1
    discriminant = b * b - a * c
    root = np.sqrt(np.maximum(discriminant, 0))
    missed = discriminant < 0
    return np.where(missed, np.inf, (-b - root) / a), np.where(missed, -np.inf, (-b + root) / a)


# A box's faces as seen from outside: outward normal, right, up. Text on them is upright and not mirrored.
_BOX_FACES = np.array(
    [
        [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        [[0, 0, -1], [-1, 0, 0], [0, 1, 0]],
        [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    ],
    dtype=np.float64,
)


def surface_coordinates(shape: Shape, points: Array) -> tuple[npt.NDArray[np.intp], Array]:
    """Points (M, 3) on a unit shape -> face (M,) and texture coordinates (M, 2) in [0, 1]: right, and down."""
    if shape is Shape.BOX:
        return _box_coordinates(points)
    x, y, z = points.T
    around = np.arctan2(y, x) / (2 * np.pi) + 0.5
    if shape is Shape.ELLIPSOID:
        return np.zeros(len(points), np.intp), np.stack([around, np.arccos(np.clip(z, -1, 1)) / np.pi], 1)
    face = np.where(np.abs(z) < np.hypot(x, y), 0, np.where(z < 0, 1, 2))
    side, cap = np.stack([around, (1 - z) / 2], 1), np.stack([(1 + x) / 2, (1 - y) / 2], 1)
    return face, np.where((face == 0)[:, None], side, cap)


def box_face_coordinates(face: int, points: Array) -> Array:
    """Points (M, 3) on a face of the unit box -> texture coordinates (M, 2)."""
    uv = np.empty((len(points), 2))
    _, right, up = _BOX_FACES[face]
    for column, direction in enumerate((right, -up)):
        along = int(np.abs(direction).argmax())
        uv[:, column] = (1 + direction[along] * points[:, along].astype(np.float64)) / 2
    return uv


def _box_coordinates(points: Array) -> tuple[npt.NDArray[np.intp], Array]:
    axis = np.abs(points).argmax(1)
    face = 2 * axis + (points[np.arange(len(points)), axis] > 0)
    uv = np.empty((len(points), 2))
    for index in range(len(_BOX_FACES)):
        chosen = np.flatnonzero(face == index)
        if len(chosen):
            uv[chosen] = box_face_coordinates(index, points[chosen])
    return face, uv


def face_points(shape: Shape, face: int, u: Array, v: Array) -> tuple[Array, Array]:
    """Inverse of surface_coordinates: points (..., 3) on a unit shape's face and their outward normals (..., 3)."""
    if shape is Shape.BOX:
        normal, right, up = _BOX_FACES[face]
        points = normal + (2 * u - 1)[..., None] * right + (1 - 2 * v)[..., None] * up
        return points, np.broadcast_to(normal, points.shape)
    longitude = (u - 0.5) * 2 * np.pi
    if shape is Shape.ELLIPSOID:
        sine, cosine = np.sin(v * np.pi), np.cos(v * np.pi)
        points = np.stack([sine * np.cos(longitude), sine * np.sin(longitude), cosine], -1)
        return points, points
    if face == 0:
        normals = np.stack([np.cos(longitude), np.sin(longitude), np.zeros_like(u)], -1)
        return normals + (1 - 2 * v)[..., None] * np.array([0.0, 0.0, 1.0]), normals
    normal = np.array([0.0, 0.0, -1.0 if face == 1 else 1.0])
    points = np.stack([2 * u - 1, 1 - 2 * v, np.zeros_like(u)], -1) + normal
    return points, np.broadcast_to(normal, points.shape)


def face_size(shape: Shape, axes: Array, face: int) -> tuple[float, float]:
    """(width, height) of a face's skin in metres; of a round one, at its equator."""
    lengths = 2 * np.linalg.norm(axes, axis=0)
    if shape is Shape.ELLIPSOID or (shape is Shape.CYLINDER and face == 0):
        return np.pi * (lengths[0] + lengths[1]) / 2, lengths[2] * (np.pi / 2 if shape is Shape.ELLIPSOID else 1)
    if shape is Shape.CYLINDER:
        return lengths[0], lengths[1]
    _, right, up = np.abs(_BOX_FACES[face])
    return float(lengths @ right), float(lengths @ up)


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


# Casts a camera's rays on solids: the colour and the depth of what each ray meets first.

Matrix = npt.NDArray[np.float64]
Camera = tuple[Matrix, Matrix]  # T_world_camera (4, 4); K (3, 3), centre of the top-left pixel at (0.5, 0.5)
Window = tuple[slice, slice]  # rows, columns

NEAR = 0.05  # metres; nothing closer is seen

_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])  # of a solid's eight corners


def cast(
    solids: Sequence[Solid], camera: Camera, width: int, height: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """(H, W, 3) 8-bit colours of the nearest surfaces and (H, W) their z, camera frame, inf for nothing."""
    z, nearest = trace(solids, camera, width, height)
    return colour_pixels(solids, camera, z, nearest), z


def trace(
    solids: Sequence[Solid],
    camera: Camera,
    width: int,
    height: int,
    beyond: Array | float = NEAR,
    columns: Sequence[slice] | None = None,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """(H, W) z of the nearest surfaces, camera frame, inf for nothing; (H, W) whose they are, -1 for nothing.

    Rays begin at the z of `beyond`, one for all or (H, W); where that is inf, they meet nothing.
    `columns`: of the image, by solid, those in which it can be seen.
    """
    z = np.full((height, width), np.inf, np.float32)
    nearest = np.full((height, width), -1, np.int32)
    start = np.broadcast_to(np.asarray(beyond, np.float32), z.shape)
    for index, solid in enumerate(solids):
        window = _window(solid, camera, width, height)
        if window is not None and columns is not None:
            window = _within(window, columns[index])
        if window is None:
            continue
        near, far = ray_interval(solid.shape, *_local_rays(solid, camera, window))
        closer = (near <= far) & (near > start[window]) & (near < z[window])
        z[window][closer] = near[closer]
        nearest[window][closer] = index
    return z, nearest


def colour_pixels(
    solids: Sequence[Solid], camera: Camera, z: npt.NDArray[np.float32], nearest: npt.NDArray[np.int32]
) -> npt.NDArray[np.float32]:
    """(H, W, 3) 8-bit colours of what `trace` found; black where it found nothing."""
    colours = np.zeros((*z.shape, 3), np.float32)
    order = np.argsort(nearest.astype(np.int16), axis=None, kind="stable")  # of 16 bits: by radix
    ends = np.searchsorted(nearest.ravel()[order], np.arange(len(solids) + 1))
    for solid, begin, end in zip(solids, ends[:-1], ends[1:], strict=True):
        if begin < end:
            rows, columns = np.divmod(order[begin:end], z.shape[1])
            origin, along_row, along_column = _ray_parts(solid, camera, z.shape)
            t = z[rows, columns]
            parts = zip(origin, along_row, along_column, strict=True)
            points = np.stack([o + t * (a[columns] + b[rows]) for o, a, b in parts], 1)
            colours[rows, columns] = _skin_colours(solid, points)
    return colours


def _local_rays(solid: Solid, camera: Camera, window: Window) -> tuple[list[np.float32], list[Array]]:
    """Origin (x, y, z) and directions (x, y, z of shape (h, w)) of a window's rays in the solid's own frame.

    The directions' z in the camera's frame is 1, so that the rays' parameter t is that z.
    """
    rows, columns = window
    origin, along_row, along_column = _ray_parts(solid, camera, (rows.stop, columns.stop))
    parts = zip(along_row, along_column, strict=True)
    return origin, [a[columns] + b[rows, None] for a, b in parts]


def _ray_parts(solid: Solid, camera: Camera, shape: tuple[int, int]) -> tuple[list[np.float32], list, list]:
    """The rays' origin in the solid's frame, and their directions as sums of a part by column and a part by row."""
    T_world_camera, K = camera
    local_from_pixel = solid.inverse @ T_world_camera[:3, :3] @ np.linalg.inv(K)
    rows, columns = (np.arange(size) + 0.5 for size in shape)
    along_row = [(a * columns + c).astype(np.float32) for a, _, c in local_from_pixel]
    along_column = [(b * rows).astype(np.float32) for _, b, _ in local_from_pixel]
    return [np.float32(value) for value in solid.transform_to_local(T_world_camera[:3, 3])], along_row, along_column


def _window(solid: Solid, camera: Camera, width: int, height: int) -> Window | None:
    """The pixels that may see the solid, by the corners of what of it is in front of the camera; None for none."""
    T_world_camera, K = camera
    corners = (solid.corners - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    ahead = corners[:, 2] >= NEAR
    if not ahead.all():
        if not ahead.any():
            return None
        first, last = _EDGES[ahead[_EDGES[:, 0]] != ahead[_EDGES[:, 1]]].T
        share = (NEAR - corners[first, 2]) / (corners[last, 2] - corners[first, 2])
        cut = corners[first] + share[:, None] * (corners[last] - corners[first])
        corners = np.concatenate([corners[ahead], cut])
    pixels = (corners / corners[:, 2:]) @ K.T[:, :2]
    left, top = np.clip(np.floor(pixels.min(0)), 0, (width, height)).astype(int)
    right, bottom = np.clip(np.ceil(pixels.max(0)), 0, (width, height)).astype(int)
    return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


def _within(window: Window, columns: slice) -> Window | None:
    rows, own = window
    left, right = max(own.start, columns.start), min(own.stop, columns.stop)
    return (rows, slice(left, right)) if left < right else None


def _skin_colours(solid: Solid, points: Array) -> npt.NDArray[np.float32]:
    """(M, 3) bilinear colours of the skins at points (M, 3) in the solid's own frame."""
    painted = [index for index, skin in enumerate(solid.skins) if skin.shape[:2] != (1, 1)]
    if solid.shape is Shape.BOX and len(painted) == 1:
        return _bilinear(solid.skins[painted[0]], box_face_coordinates(painted[0], points))
    face, uv = surface_coordinates(solid.shape, points)
    colours = np.empty((len(points), 3), np.float32)
    for index, skin in enumerate(solid.skins):
        chosen = np.flatnonzero(face == index)
        if len(chosen):
            colours[chosen] = _bilinear(skin, uv[chosen])
    return colours


def _bilinear(skin: npt.NDArray[np.uint8], uv: Array) -> npt.NDArray[np.float32]:
    """(M, 3) colours at uv (M, 2) in [0, 1]."""
    columns = 4096  # cv2.remap wants an image, of fewer than 32768 columns
    texels = np.zeros((-(-len(uv) // columns) * columns, 2), np.float32)
    texels[: len(uv)] = uv * (skin.shape[1], skin.shape[0]) - 0.5
    x, y = (texels[:, axis].reshape(-1, columns) for axis in (0, 1))
    colours = cv2.remap(skin.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return colours.reshape(-1, 3)[: len(uv)].astype(np.float32, copy=False)


# Casts through a lens that bends lines: pinholes to five sides see the place, and the lens' rays choose among them.

Array64 = npt.NDArray[np.float64]

_REACH = 1.02  # of a side's picture at depth 1, so that what is interpolated at its edge is in it
# R_camera_side (3, 3): ahead, right, left, down, up.
_SIDES = tuple(
    np.array(columns, float).T
    for columns in (
        ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
        ([0, 0, -1], [0, 1, 0], [1, 0, 0]),
        ([0, 0, 1], [0, 1, 0], [-1, 0, 0]),
        ([1, 0, 0], [0, 0, -1], [0, 1, 0]),
        ([1, 0, 0], [0, 0, 1], [0, -1, 0]),
    )
)


def cast_through(
    solids: Sequence[Solid], T_world_camera: Array64, lens: Intrinsics
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """(H, W, 3) 8-bit colours and (H, W) z in the camera's frame, negative behind it, of a picture through `lens`.

    Colours are interpolated between rays as dense as the lens' in its middle. Black, and inf, where nothing is, where
    the lens sees nothing, and farther than 135 degrees from the axis.
    """
    pixels = np.stack(np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5), -1)
    rays = unproject(np.asarray(pixels.reshape(-1, 2), np.float64), lens).reshape(lens.height, lens.width, 3)
    colours = np.zeros((lens.height, lens.width, 3), np.float32)
    z = np.full((lens.height, lens.width), np.inf, np.float32)
    focal = max(lens.fx, lens.fy)
    side = int(np.ceil(2 * _REACH * focal))
    K = np.array([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
    for R_camera_side in _SIDES:
        local = rays @ R_camera_side
        chosen = (local[..., 2] > 0) & (np.abs(local[..., :2]).max(-1) <= local[..., 2])
        if not chosen.any():
            continue
        T_camera_side = np.eye(4)
        T_camera_side[:3, :3] = R_camera_side
        seen, depth = cast(solids, (T_world_camera @ T_camera_side, K), side, side)
        at = np.where(chosen[..., None], local[..., :2] / np.where(chosen, local[..., 2], 1.0)[..., None], 0.0)
        columns, rows = np.moveaxis(at * focal + side / 2 - 0.5, -1, 0).astype(np.float32)
        colours[chosen] = cv2.remap(seen, columns, rows, cv2.INTER_LINEAR)[chosen]
        along = cv2.remap(depth, columns, rows, cv2.INTER_NEAREST)[chosen]
        z[chosen] = np.where(np.isfinite(along), along * (rays[..., 2] / local[..., 2])[chosen], np.inf)
    return colours, z


# A camera that looks at a point.


def look_at(centre: Matrix, target: Matrix, roll_deg: float = 0.0) -> Matrix:
    """T_world_camera (4, 4) at `centre`, its z axis towards `target`, upright in a world whose z is up, then rolled."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cosine, sine = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack([cosine * right + sine * down, cosine * down - sine * right, forward], 1)
    T_world_camera[:3, 3] = centre
    return T_world_camera


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
