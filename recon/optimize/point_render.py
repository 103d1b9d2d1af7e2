"""Point rendering: each pixel blends the colours of the nearest points, and is white where there are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]
_DISTANCE_STEPS = 2**16  # into which distances are quantised, so that pixel and distance sort by one integer key
_MIN_DEPTH = 1e-6  # z of a point in front of the camera


@dataclass(frozen=True, eq=False)
class PointRender:
    """The points as a camera sees them; `seen` says where there are any."""

    rgb: Array  # (H, W, 3) in [0, 1], white where nothing is seen
    depth: Array  # (H, W) z in the camera frame of the frontmost point, 0 where nothing is seen
    normal: Array  # (H, W, 3) camera frame, unit length, facing the camera, 0 where nothing is seen
    seen: npt.NDArray[np.bool_]  # (H, W)


def render_points(
    points: Array,  # (M, 3) world
    colours: Array,  # (M, 3) in [0, 1]
    normals: Array,  # (M, 3) world, unit length
    T_world_camera: npt.NDArray[np.float64],  # (4, 4)
    K: npt.NDArray[np.float64],  # (3, 3)
    width: int,
    height: int,
    *,
    nearest: int = 8,  # K
    radius: float = 1.5,  # pixels
    same_surface: float = 0.02,  # share of the depth
) -> PointRender:
    """The point-rendered image of equation 6.

    A point is a candidate for the pixels whose centres lie within `radius` pixels of its projection. Of a pixel's
    candidates those count that lie on the frontmost surface (z at most `same_surface` behind the first, relatively):
    a surface hides what is behind it. The `nearest` K of them by image distance d are blended with weights
    exp(-d) / sum of exp(-d). Points seen from behind are left out.
    """
    to_camera = np.linalg.inv(T_world_camera).astype(np.float32)
    in_camera = points @ to_camera[:3, :3].T + to_camera[:3, 3]
    turned = normals @ to_camera[:3, :3].T
    in_front = (in_camera[:, 2] > _MIN_DEPTH) & ((turned * in_camera).sum(1) <= 0)
    index = np.flatnonzero(in_front)
    z = in_camera[index, 2]
    u = in_camera[index, 0] / z * np.float32(K[0, 0]) + np.float32(K[0, 2])
    v = in_camera[index, 1] / z * np.float32(K[1, 1]) + np.float32(K[1, 2])
    visible = (np.abs(u - 0.5 * width) < 0.5 * width + radius) & (np.abs(v - 0.5 * height) < 0.5 * height + radius)
    index, z, u, v = index[visible], z[visible], u[visible], v[visible]

    pixel, point, distance = _candidates(u, v, width, height, radius)
    depth = np.full(height * width, np.inf, np.float32)
    np.minimum.at(depth, pixel, z[point])
    front = z[point] <= depth[pixel] * (1 + same_surface)
    pixel, point, distance = pixel[front], point[front], distance[front]
    order = np.argsort(pixel * _DISTANCE_STEPS + (distance * (_DISTANCE_STEPS / (radius + 1.0))).astype(np.int64))
    pixel, point, distance = pixel[order], point[order], distance[order]
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    rank = np.arange(len(pixel)) - np.repeat(first, np.diff(first, append=len(pixel)))
    chosen = rank < nearest
    pixel, point, weight = pixel[chosen], index[point[chosen]], np.exp(-distance[chosen])

    total = np.bincount(pixel, weight, height * width)
    seen = total > 0

    def blend_values(values: Array) -> Array:
        sums = [np.bincount(pixel, weight * values[point, k], height * width) for k in range(3)]
        return (np.stack(sums, 1) / np.where(seen, total, 1.0)[:, None]).astype(np.float32)

    rgb = np.where(seen[:, None], blend_values(colours), np.float32(1.0))
    normal = blend_values(turned)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return PointRender(
        rgb=rgb.reshape(height, width, 3),
        depth=np.where(seen, depth, 0).astype(np.float32).reshape(height, width),
        normal=np.where(seen[:, None], normal, 0).reshape(height, width, 3),
        seen=seen.reshape(height, width),
    )


def _candidates(
    u: Array, v: Array, width: int, height: int, radius: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Array]:
    """(pixel, point, distance) of every pixel centre within `radius` of a projection (u, v), each of shape (C,)."""
    reach = int(np.ceil(radius - 0.5))
    columns = [_find_neighbour_pixels(u, step, width) for step in range(-reach, reach + 1)]
    rows = [_find_neighbour_pixels(v, step, height) for step in range(-reach, reach + 1)]
    pixels, members, distances = [], [], []
    for y, vertical, in_rows in rows:
        for x, horizontal, in_columns in columns:
            squared = vertical + horizontal
            inside = np.flatnonzero((squared <= radius * radius) & in_rows & in_columns)
            pixels.append(y[inside] * width + x[inside])
            members.append(inside)
            distances.append(np.sqrt(squared[inside]))
    return np.concatenate(pixels), np.concatenate(members), np.concatenate(distances)


def _find_neighbour_pixels(
    at: Array, step: int, size: int
) -> tuple[npt.NDArray[np.int64], Array, npt.NDArray[np.bool_]]:
    """The pixels `step` beside those at (C,) along one axis, the squared distances of their centres, if they exist."""
    pixel = np.floor(at).astype(np.int64) + step
    return pixel, (pixel.astype(np.float32) + np.float32(0.5) - at) ** 2, (pixel >= 0) & (pixel < size)
