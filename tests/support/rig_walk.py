"""A robot with three cameras on a rig, on its way through the built-in building: images with true poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Clock, Frame, Intrinsics, Stamp
from splatnode.extras.cameras import building

Array = npt.NDArray[np.float64]

STEP = 0.5  # keyframes of the walk between two frame sets
SET_NS = 500_000_000  # between two frame sets
_LENS = ((0, 0), (1, 1), (0, 2), (1, 2))  # of K: focal lengths, principal point


@dataclass(frozen=True, eq=False)
class RigWalk:
    """Frames of a rig, and what is true of them."""

    frames: tuple[Frame, ...]
    poses: Mapping[str, Array]  # T_world_camera (4, 4) metres, by name


def true_mounts() -> dict[str, Array]:
    """T_rig_camera (4, 4) in metres, by camera id: the rig is the camera in the middle."""
    found = {}
    for camera_id, yaw_deg, (x, y, z) in (
        ("front", 0.0, (0.0, 0.0, 0.0)),
        ("left", -35.0, (-0.22, 0.03, -0.05)),
        ("right", 32.0, (0.25, -0.02, -0.04)),
    ):
        radians = np.radians(yaw_deg)
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.array([0.0, radians, 0.0]))[0]
        T[:3, 3] = x, y, z
        found[camera_id] = T
    return found


def make_rig_walk(
    num_sets: int,
    mounts: Mapping[str, Array] | None = None,
    later: Mapping[str, Array] | None = None,
    moved_at: int | None = None,
    size: tuple[int, int] = (400, 300),
    lens_told: bool = False,
    first: float = 4.0,
) -> RigWalk:
    """Photographs of `num_sets` frame sets; from set `moved_at` on, cameras are mounted as `later` has them."""
    config = building.Config(keyframes=60, width=size[0], height=size[1], samples=1, noise=1.0)
    frames, poses = [], {}
    for index in range(num_sets):
        at = first + STEP * index
        T_world_rig, K = building.scene_camera(config, at)
        mounted = dict(mounts or true_mounts())
        if moved_at is not None and index >= moved_at:
            mounted |= later or {}
        for offset, (camera_id, T_rig_camera) in enumerate(sorted(mounted.items())):
            T = T_world_rig @ T_rig_camera
            name = f"{camera_id}_{index:03d}.png"
            image = _render(config, at, (T, K), 3 * index + offset)
            stamp_ns = index * SET_NS + offset * 1_000_000
            lens = Intrinsics(*size, *(float(K[at]) for at in _LENS), source="given") if lens_told else None
            frames.append(
                Frame(
                    len(frames),
                    name,
                    stamp_ns,
                    image,
                    intrinsics=lens,
                    captured_at=Stamp(stamp_ns, Clock.RECORDING),
                    camera_id=camera_id,
                )
            )
            poses[name] = T
    return RigWalk(tuple(frames), poses)


def _render(config: building.Config, at: float, camera: tuple[Array, Array], seed: int) -> npt.NDArray[np.uint8]:
    T, K = camera
    dense = T, np.diag([2.0, 2.0, 1.0]) @ K
    colours = building.view(building.state(config, at), dense, 2 * config.width, 2 * config.height)
    image = cv2.resize(colours, (config.width, config.height), interpolation=cv2.INTER_AREA)
    grain = np.random.default_rng([config.seed, seed]).standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + config.noise * grain), 0, 255).astype(np.uint8)
