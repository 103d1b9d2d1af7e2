"""A room whose free space is known: a floor and a wall, and cameras that see them at exact depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama import look_at
from splatnode.recon.occupancy import OccupancyMap, Upright
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from tests.support.exported import make_snapshot

K = np.array([[200.0, 0, 128], [0, 200, 96], [0, 0, 1]])
WIDTH, HEIGHT = 256, 192  # of a photograph; of its depths, half as much
WALL = 2.0  # the plane x = WALL; the floor is z = 0


def seen_depth(T_world_camera: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """(h, w) z of the wall or the floor, whichever is nearer."""
    columns, rows = np.meshgrid(2 * np.arange(WIDTH // 2) + 1.0, 2 * np.arange(HEIGHT // 2) + 1.0)
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], -1)
    rays = rays @ T_world_camera[:3, :3].T
    x, _, z = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        wall, floor = (WALL - x) / rays[..., 0], -z / rays[..., 2]
    wall, floor = (np.where(each > 0, each, np.inf) for each in (wall, floor))
    return np.minimum(wall, floor).astype(np.float32)


def room_snapshot() -> Snapshot:
    """Three cameras beside each other in a world whose axes are those of none; its verdict is OK."""
    Ts = [look_at(np.array([0.0, y, 1.0]), np.array([WALL, y / 2, 0.3])) for y in (-0.6, 0.0, 0.6)]
    cameras = tuple(CameraEstimate(f"{index}.png", index, T, K, WIDTH, HEIGHT, None) for index, T in enumerate(Ts))
    depths = {
        camera.name: np.where(np.isfinite(depth := seen_depth(camera.T_world_camera)), depth, 0).astype(np.float16)
        for camera in cameras
    }
    return replace(make_snapshot(), cameras=cameras, depths=depths)


def small_map(states: npt.NDArray[np.uint8], voxel: float = 0.25, first: tuple[int, int, int] = (-3, -2, 1)):
    """A map of these states whose first voxel has that number along each axis."""
    frame = Upright(np.eye(4), "the floor", on_floor=True)
    return OccupancyMap(states.astype(np.uint8), voxel, np.array(first) * voxel, frame)
