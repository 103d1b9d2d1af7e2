"""Casts a camera's rays on solids: the colour and the depth of what each ray meets first."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.solids import Array, Solid, ray_interval, surface_coordinates

Matrix = npt.NDArray[np.float64]
Camera = tuple[Matrix, Matrix]  # T_world_camera (4, 4); K (3, 3), centre of the top-left pixel at (0.5, 0.5)
Window = tuple[slice, slice]  # rows, columns

NEAR = 0.05  # metres; nothing closer is seen


def cast(
    solids: Sequence[Solid], camera: Camera, width: int, height: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """(H, W, 3) 8-bit colours of the nearest surfaces and (H, W) their z, camera frame, inf for nothing."""
    z = np.full((height, width), np.inf, np.float32)
    nearest = np.full((height, width), -1, np.int32)
    windows = [_window(solid, camera, width, height) for solid in solids]
    for index, (solid, window) in enumerate(zip(solids, windows, strict=True)):
        near, far = ray_interval(solid.shape, *_local_rays(solid, camera, window))
        closer = (near <= far) & (near > NEAR) & (near < z[window])
        z[window][closer] = near[closer]
        nearest[window][closer] = index
    colours = np.zeros((height, width, 3), np.float32)
    for index, (solid, window) in enumerate(zip(solids, windows, strict=True)):
        seen = nearest[window] == index
        if seen.any():
            origin, direction = _local_rays(solid, camera, window)
            t = z[window][seen]
            points = np.stack([o + t * d[seen] for o, d in zip(origin, direction, strict=True)], 1)
            colours[window][seen] = _skin_colours(solid, points)
    return colours, z


def _local_rays(solid: Solid, camera: Camera, window: Window) -> tuple[list[np.float32], list[Array]]:
    """Origin (x, y, z) and directions (x, y, z of shape (h, w)) of a window's rays in the solid's own frame.

    The directions' z in the camera's frame is 1, so that the rays' parameter t is that z.
    """
    T_world_camera, K = camera
    rows, columns = (np.arange(part.start, part.stop) + 0.5 for part in window)
    local_from_pixel = solid.inverse @ T_world_camera[:3, :3] @ np.linalg.inv(K)
    direction = [
        (a * columns + c).astype(np.float32) + (b * rows).astype(np.float32)[:, None] for a, b, c in local_from_pixel
    ]
    return [np.float32(value) for value in solid.to_local(T_world_camera[:3, 3])], direction


def _window(solid: Solid, camera: Camera, width: int, height: int) -> Window:
    """The pixels that may see the solid: all where it reaches behind the camera."""
    T_world_camera, K = camera
    corners = (solid.corners - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    if corners[:, 2].min() < NEAR:
        return slice(0, height), slice(0, width)
    pixels = (corners / corners[:, 2:]) @ K.T[:, :2]
    left, top = np.clip(np.floor(pixels.min(0)), 0, (width, height)).astype(int)
    right, bottom = np.clip(np.ceil(pixels.max(0)), 0, (width, height)).astype(int)
    return slice(top, bottom), slice(left, right)


def _skin_colours(solid: Solid, points: Array) -> npt.NDArray[np.float32]:
    """(M, 3) bilinear colours of the skins at points (M, 3) in the solid's own frame."""
    face, uv = surface_coordinates(solid.shape, points)
    colours = np.empty((len(points), 3), np.float32)
    for index, skin in enumerate(solid.skins):
        chosen = face == index
        if chosen.any():
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
