"""A simulated depth camera beside the built-in capture's: noise and holes of an OAK, and errors that it may have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.depth_image import DepthImage, make_depth_image
from splatnode.capture.frame import Frame, Intrinsics

_FOCAL_BASELINE = 450 * 0.075  # pixels metres of an OAK at 640 pixels across
_STEP_PX = 1 / 8  # of disparity
_FARTHEST_M = 12.0


@dataclass(frozen=True)
class DepthCamera:
    """What is wrong with a depth camera."""

    noise_px: float = 0.25  # of disparity
    holes: float = 0.12  # share of pixels without a depth, in blobs
    scale: float = 1.0  # by which every depth is too large
    shift_px: tuple[float, float] = (0.0, 0.0)  # by which the depth image lies beside its photograph, at 640 across
    aside_m: float = 0.0  # by which it stands to the right of its photograph's camera
    is_aside_told: bool = False  # whether the depth image says so
    seed: int = 0


def measure(z: npt.NDArray[np.float32], camera: DepthCamera, number: int = 0) -> DepthImage:
    """What the camera tells of true depths (H, W), metres, infinite where nothing is: millimetres, aligned."""
    rng = np.random.default_rng([camera.seed, number])
    height, width = z.shape
    far = np.where(np.isfinite(z), z, 1e6)
    unit = width / 640
    moved = np.array([[1, 0, camera.shift_px[0] * unit], [0, 1, camera.shift_px[1] * unit]])
    far = cv2.warpAffine(far, moved, (width, height), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    grain = cv2.GaussianBlur(rng.normal(size=z.shape), (0, 0), 1.5 * unit)
    disparity = _FOCAL_BASELINE / far + camera.noise_px * grain / grain.std()
    disparity = np.rint(disparity / _STEP_PX) * _STEP_PX
    seen = camera.scale * _FOCAL_BASELINE / np.maximum(disparity, 1e-3)
    blobs = cv2.GaussianBlur(rng.normal(size=z.shape), (0, 0), 12 * unit)
    edges = cv2.dilate(far, np.ones((5, 5))) > 1.1 * cv2.erode(far, np.ones((5, 5)))
    holes = (blobs < np.quantile(blobs, camera.holes)) | edges | (seen > _FARTHEST_M) | (disparity <= 0)
    return make_depth_image(np.where(holes, 0, np.rint(1000 * seen)).clip(0, 65_535).astype(np.uint16))


def add_depths(frames: Sequence[Frame], config: synthetic.Config, camera: DepthCamera | None = None) -> list[Frame]:
    """The photographs of the built-in capture, each with what the depth camera measured."""
    camera = camera or DepthCamera()
    return [replace(each, depth=photograph_depth(config, camera, i)) for i, each in enumerate(frames)]


def photograph_depth(
    config: synthetic.Config, camera: DepthCamera, index: int, number: int | None = None
) -> DepthImage:
    """What the camera tells beside a photograph of the built-in capture; `number` chooses its noise, else `index`."""
    T, K = synthetic.scene_cameras(config)[index]
    T_camera_depth = np.eye(4)
    T_camera_depth[0, 3] = camera.aside_m
    z = synthetic.depth_map(config, (T @ T_camera_depth, K))
    found = measure(z, camera, index)
    if not camera.is_aside_told:
        return found
    lens = Intrinsics(config.width, config.height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "given")
    return replace(found, intrinsics=lens, T_camera_depth=tuple(T_camera_depth.ravel().tolist()))


def measure_along_rays(depth: DepthImage, K: npt.NDArray[np.float64]) -> DepthImage:
    """The same as distances along the rays, as simulators have them; `K` (3, 3) is of the depth image's pixels."""
    height, width = depth.values.shape
    x, y = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    lengths = np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2)
    return replace(depth, values=np.rint(depth.values * lengths).clip(0, 65_535).astype(np.uint16))


def whitewash(frames: Sequence[Frame], config: synthetic.Config) -> list[Frame]:
    """The photographs with plain walls: shaded, without anything to match but what stands before them."""
    found = []
    for index, frame in enumerate(frames):
        (T, K), z = synthetic.scene_cameras(config)[index], synthetic.depth(config, index)
        across, down = np.meshgrid(np.arange(frame.width) + 0.5, np.arange(frame.height) + 0.5)
        rays = np.stack([(across - K[0, 2]) / K[0, 0], (down - K[1, 2]) / K[1, 1], np.ones_like(across)], -1)
        with np.errstate(invalid="ignore"):
            points = (rays * z[..., None]) @ T[:3, :3].T + T[:3, 3]
            wall = (np.abs(points[..., :2]) < 0.01).any(-1)
        light = np.where(np.abs(points[..., 0]) < 0.01, 190.0, 165.0) + 8.0 * np.nan_to_num(points[..., 2])
        grain = np.random.default_rng([config.seed, index]).normal(size=frame.image.shape)
        plain = np.clip(np.rint(light[..., None] + grain), 0, 255).astype(np.uint8)
        found.append(replace(frame, image=np.where(wall[..., None], plain, frame.image)))
    return found
