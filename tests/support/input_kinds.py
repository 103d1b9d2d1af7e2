"""Images of other kinds: stereo halves, 360 degrees, a thing on a turntable before a background."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import PALETTES, Builder, cast, look_at, table
from splatnode.capture.frame import Frame
from splatnode.extras.cameras import building
from tests.support.synthetic import renumbered

# R_camera_side (3, 3): ahead, right, left, down, up, back.
_SIDES = [
    np.array(columns, float).T
    for columns in (
        ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
        ([0, 0, -1], [0, 1, 0], [1, 0, 0]),
        ([0, 0, 1], [0, 1, 0], [-1, 0, 0]),
        ([1, 0, 0], [0, 0, -1], [0, 1, 0]),
        ([1, 0, 0], [0, 0, 1], [0, -1, 0]),
        ([-1, 0, 0], [0, 1, 0], [0, 0, -1]),
    )
]
_DISTANCE, _HEIGHT = 2.6, 1.5  # of the camera before the turntable, metres


@lru_cache(maxsize=2)
def stereo_halves(views: int, baseline_m: float = 0.065) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """What a stereo camera's left and right half see of the built-in place."""
    config = synthetic.Config(views=views, width=480, height=360, samples=1, noise=0.0)
    cameras = synthetic.scene_cameras(config)
    rights = [synthetic.offset_right_camera(camera, baseline_m) for camera in cameras]
    return tuple(
        (_noisy(synthetic.render_image(config, left), 2 * i), _noisy(synthetic.render_image(config, right), 2 * i + 1))
        for i, (left, right) in enumerate(zip(cameras, rights, strict=True))
    )


@lru_cache(maxsize=1)
def panoramas(views: int, width: int = 768) -> tuple[Frame, ...]:
    """Equirectangular images of a walk through the built-in building."""
    config = building.Config(width=width, height=width // 2)
    return tuple(renumbered(_panorama(config, 20 + 3 * index, width) for index in range(views)))


def _panorama(config: building.Config, index: int, width: int) -> np.ndarray:
    T_world_camera, _ = building.scene_camera(config, index)
    ahead = T_world_camera[:3, 2] * (1.0, 1.0, 0.0)
    T_world_camera = look_at(T_world_camera[:3, 3], T_world_camera[:3, 3] + ahead)
    focal, side = width / 4, int(0.51 * width)
    K = np.array([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
    longitude = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    latitude = np.pi / 2 - (np.arange(width // 2) + 0.5) / (width // 2) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    level = np.cos(latitude)
    rays = np.stack([level * np.sin(longitude), -np.sin(latitude), level * np.cos(longitude)], -1)
    image = np.zeros((*rays.shape[:2], 3), np.float32)
    for R_camera_side in _SIDES:
        local = rays @ R_camera_side
        inside = (local[..., 2] > 0) & (np.abs(local[..., :2]).max(-1) <= 1.0001 * local[..., 2])
        T_camera_side = np.eye(4)
        T_camera_side[:3, :3] = R_camera_side
        with np.errstate(invalid="ignore"):  # a side that looks straight up or down has no azimuth
            seen = building.view(building.state(config, index), (T_world_camera @ T_camera_side, K), side, side)
        at = local[..., :2] / np.where(inside, local[..., 2], 1.0)[..., None] * focal + side / 2 - 0.5
        columns, rows = np.moveaxis(at.astype(np.float32), -1, 0)
        image[inside] = cv2.remap(seen, columns, rows, cv2.INTER_LINEAR)[inside]
    return _noisy(image, index)


@lru_cache(maxsize=4)
def turned(views: int, plain: bool = False) -> tuple[tuple[Frame, ...], tuple[np.ndarray, ...]]:
    """A table on a turntable, 10 degrees a view, before a room or something plain; masks (H, W), True on the table."""
    builder = Builder(0, 400.0)
    table(builder, PALETTES[0], 0.0, 0.0, 0.0)
    background = building.render_image(building.Config(width=480, height=360), 20).astype(np.float32)
    if plain:
        background[:] = 120.0
    K = np.array([[525.0, 0.0, 240.0], [0.0, 525.0, 180.0], [0.0, 0.0, 1.0]])
    images, masks = [], []
    for index in range(views):
        azimuth = np.radians(10.0 * index)
        centre = np.array([_DISTANCE * np.cos(azimuth), _DISTANCE * np.sin(azimuth), _HEIGHT])
        colours, depth = cast(tuple(builder.solids), (look_at(centre, np.array([0.0, 0.0, 0.6])), K), 480, 360)
        shown = np.isfinite(depth)
        images.append(_noisy(np.where(shown[..., None], 0.8 * colours, background), index))
        masks.append(shown)
    return tuple(renumbered(images)), tuple(masks)


def _noisy(image: np.ndarray, seed: int) -> np.ndarray:
    """As a sensor sees it; 8 bits."""
    grain = np.random.default_rng(seed).normal(size=image.shape)
    return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)
