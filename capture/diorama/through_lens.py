"""Casts through a lens that bends lines: pinholes to five sides see the place, and the lens' rays choose among them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.cast import cast
from splatnode.capture.diorama.solids import Solid
from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses.lens import unproject

Array = npt.NDArray[np.float64]

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
    solids: Sequence[Solid], T_world_camera: Array, lens: Intrinsics
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
