"""Casts a camera's rays on solids: the colour and the depth of what each ray meets first."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.solids import (
    Array,
    Shape,
    Solid,
    box_face_coordinates,
    ray_interval,
    surface_coordinates,
)

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
