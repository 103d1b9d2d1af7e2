"""Known scenes for tests: photographs of the synthetic place, ways to spoil them, and a handful of Gaussians."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import msgspec
import numpy as np
import torch
from torch import Tensor

from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import BRICK_WALL, Camera, cast, place
from splatnode.capture.frame import Frame
from splatnode.extras.evaluate.protocol import CameraErrors, compare_cameras
from splatnode.recon.keyframes import Keyframe, resize_image
from splatnode.recon.matching import features
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.view_graph import Matcher, ViewGraph, match
from splatnode.recon.priors import Pointmap
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import Gaussians

SMALL = synthetic.Config(views=6, width=320, height=240)


@lru_cache(maxsize=32)  # of a megabyte each: what is evicted is rendered again
def photographs(config: synthetic.Config = SMALL) -> tuple[Frame, ...]:
    """The stream of `config`, made once for all tests."""
    return tuple(synthetic.stream(config))


def errors(snapshot: Snapshot, config: synthetic.Config = SMALL) -> CameraErrors:
    """The snapshot's cameras against those that took the photographs of `config`."""
    true = synthetic.scene_cameras(config)
    return compare_cameras(
        np.stack([camera.T_world_camera for camera in snapshot.cameras]),
        np.stack([true[camera.frame_id][0] for camera in snapshot.cameras]),
        np.stack([camera.K for camera in snapshot.cameras]),
        np.stack([true[camera.frame_id][1] for camera in snapshot.cameras]),
    )


def renumbered(images: Iterable[np.ndarray]) -> list[Frame]:
    """Images (H, W, 3) uint8 as the frames of one stream."""
    return [
        Frame(index, synthetic.frame_name(index), index * 500_000_000, image, intrinsics=None)
        for index, image in enumerate(images)
    ]


def pure_rotation_cameras(config: synthetic.Config = SMALL, step_deg: float = 8.0) -> list[Camera]:
    """Cameras that share one centre: there is no depth to find."""
    T_world_camera, K = synthetic.scene_cameras(config)[config.views // 2]
    cameras = []
    for index in range(config.views):
        turned = T_world_camera.copy()
        yaw, pitch = np.radians(step_deg * (index - (config.views - 1) / 2)), np.radians(3.0 * np.sin(2.0 * index))
        turned[:3, :3] = T_world_camera[:3, :3] @ cv2.Rodrigues(np.array([pitch, yaw, 0.0]))[0]
        cameras.append((turned, K))
    return cameras


def pure_rotation(config: synthetic.Config = SMALL, step_deg: float = 8.0) -> list[Frame]:
    cameras = pure_rotation_cameras(config, step_deg)
    return renumbered(synthetic.render_image(config, camera, index) for index, camera in enumerate(cameras))


def places(config: synthetic.Config = SMALL, seeds: tuple[int, ...] = (0, 1)) -> list[Frame]:
    """`config.views` photographs of several places, as many of each: with one of each, no two of them overlap.

    Every other place is seen in a mirror. The seeds paint and furnish one room, whose walls, table and pictures hang
    and stand alike: learned matches join two of them, and rightly so, within 2 degrees.
    """
    share = config.views // len(seeds)
    images = []
    for index, seed in enumerate(seeds):
        taken = photographs(msgspec.structs.replace(config, seed=seed, views=share))
        images += [np.ascontiguousarray(frame.image[:, :: -1 if index % 2 else 1]) for frame in taken]
    return renumbered(images)


def planar(config: synthetic.Config = SMALL) -> list[Frame]:
    """Photographs of the brick wall alone, so close that it fills them."""
    wall = place(config.seed, density=0.5 * config.width)[BRICK_WALL]
    images = []
    for azimuth in np.radians(np.linspace(-25, 25, config.views)):
        centre = np.array([1.6 * np.cos(azimuth), 1.6 + 1.6 * np.sin(azimuth), 1.5 + 0.2 * np.sin(5 * azimuth)])
        T_world_camera = synthetic.look_at(centre, np.array([0.0, 1.6, 1.4]))
        K = synthetic.intrinsic_matrix(config, 0.9 * config.width)
        colours, _ = cast([wall], (T_world_camera, K), config.width, config.height)
        images.append(np.clip(np.rint(colours), 0, 255).astype(np.uint8))
    return renumbered(images)


def textureless(config: synthetic.Config = SMALL) -> list[Frame]:
    """Smooth shading and sensor noise, as of a white wall."""
    grain = np.random.default_rng(config.seed)
    sigma = 0.15 * config.width
    smooth = [cv2.GaussianBlur(frame.image.astype(np.float32), (0, 0), sigma) for frame in photographs(config)]
    return renumbered(_eight_bit(image + grain.normal(size=image.shape)) for image in smooth)


def repeated(frames: Iterable[Frame], times: int) -> list[Frame]:
    """Every frame `times` times in succession."""
    return renumbered(frame.image for frame in frames for _ in range(times))


def blurred(frame: Frame, length: int, angle_deg: float = 0.0) -> Frame:
    """As if the camera had moved `length` pixels while the shutter was open."""
    kernel = np.zeros((2 * length + 1, 2 * length + 1), np.float32)
    half = length / 2 * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    ends = [tuple(int(value) for value in np.rint((length + sign * half) * 16)) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1, cv2.LINE_AA, shift=4)
    return replace(frame, image=_eight_bit(cv2.filter2D(frame.image.astype(np.float32), -1, kernel / kernel.sum())))


def exposed(frame: Frame, gain: float) -> Frame:
    """As if the shutter had been open `gain` times as long."""
    linear = (frame.image / 255.0) ** 2.2 * gain
    return replace(frame, image=_eight_bit(255 * np.clip(linear, 0, 1) ** (1 / 2.2)))


def _eight_bit(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def view_graph(
    frames: Iterable[Frame], matcher: Matcher | None = None, config: matching.MatchingConfig | None = None
) -> ViewGraph:
    """The frames as keyframes, each compared with all before it."""
    config = config or matching.MatchingConfig()
    found = ((frame, features.extract(frame.image, config.features)) for frame in frames)
    return match((Keyframe(frame, resize_image(frame.image, 320), known) for frame, known in found), config, matcher)


@dataclass(frozen=True, eq=False)
class TinyScene:
    gaussians: Gaussians
    Ts_world_camera: Tensor  # (C, 4, 4)
    Ks: Tensor  # (C, 3, 3)
    width: int
    height: int


def tiny_scene(
    seed: int = 0,
    num_gaussians: int = 64,
    num_cameras: int = 3,
    width: int = 32,
    height: int = 24,
    bases: int = 1,
    dtype: torch.dtype = torch.float32,
) -> TinyScene:
    """Random Gaussians in a ball of radius 1 around the origin, and cameras on an arc 3 away that look at it."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    directions = torch.nn.functional.normalize(normal(num_gaussians, 3), dim=1)
    radii = torch.rand((num_gaussians, 1), generator=generator, dtype=torch.float64) ** (1 / 3)
    gaussians = Gaussians(
        means=directions * radii,
        quats=normal(num_gaussians, 4),
        log_scales=-1.8 + 0.4 * normal(num_gaussians, 3),
        logit_opacities=0.5 + normal(num_gaussians),
        sh=0.7 * normal(num_gaussians, bases, 3),
        source_frame=torch.zeros(num_gaussians, dtype=torch.int32),
    )
    azimuths = np.radians(np.linspace(-20, 20, num_cameras))
    centres = [np.array([3 * np.cos(a), 3 * np.sin(a), 0.4 + 0.2 * np.sin(3 * a)]) for a in azimuths]
    T_world_camera = torch.from_numpy(np.stack([synthetic.look_at(centre, np.zeros(3)) for centre in centres]))
    K = torch.tensor([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1]], dtype=dtype)
    return TinyScene(
        gaussians.map(lambda tensor: tensor.to(dtype) if tensor.is_floating_point() else tensor),
        T_world_camera.to(dtype),
        K.expand(num_cameras, 3, 3).clone(),
        width,
        height,
    )


def plane_pointmap(
    T_world_camera: np.ndarray,
    normal: tuple[float, float, float] = (0.0, 0.0, -1.0),
    point: tuple[float, float, float] = (0.0, 0.0, 2.0),
    width: int = 32,
    height: int = 24,
    confidence: float = 0.8,
    frame_id: int = 0,
) -> Pointmap:
    """What a perfect prior says of an endless plane through `point`, whose unit `normal` faces the camera (world)."""
    K = np.array([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    facing = np.array(normal) @ T_world_camera[:3, :3]
    depth = float(np.dot(normal, np.array(point) - T_world_camera[:3, 3])) / (rays @ facing)
    return Pointmap(
        name=f"{frame_id:02d}.png",
        frame_id=frame_id,
        depth=depth.astype(np.float32),
        confidence=np.full(depth.shape, confidence, np.float32),
        normal=np.broadcast_to(facing, rays.shape).astype(np.float32),
        T_world_camera=T_world_camera,
        K=K,
    )


def without(pointmap: Pointmap, hole: np.ndarray) -> Pointmap:
    """The point map with nothing known in `hole` (h, w)."""
    keep = ~hole
    return replace(
        pointmap,
        depth=pointmap.depth * keep,
        confidence=pointmap.confidence * keep,
        normal=pointmap.normal * keep[..., None],
    )
