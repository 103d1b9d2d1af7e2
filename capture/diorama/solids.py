"""Boxes, ellipsoids and cylinders, and where rays meet them.

A solid is a unit shape (box [-1, 1]^3, ball of radius 1, cylinder of radius 1 and z in [-1, 1]) under an affine map.
Rays are mapped into the unit shape's frame, which leaves the ray parameter t as it is, and every shape is an
intersection of slabs and round tubes, so that a ray's stay in it is an intersection of intervals of t.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, reduce

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating]
Vector = Sequence[Array | np.floating]  # x, y, z of many points or directions, of shapes that broadcast


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


def ray_interval(shape: Shape, origin: Vector, direction: Vector) -> tuple[Array, Array]:
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


def _tube(origin: Vector, direction: Vector) -> tuple[Array, Array]:
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
