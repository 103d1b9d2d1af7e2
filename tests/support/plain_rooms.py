"""Plain rooms: walls, a floor and boxes of one colour each, in which images have nothing to match and depth has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from splatnode.capture.diorama import Camera, Shape, Solid, cast, look_at
from splatnode.capture.frame import Frame, Intrinsics
from tests.support.depth_camera import DepthCamera, measure

SIZE = (320, 240)
_FOCAL = 0.78 * SIZE[0]  # of an OAK's colour camera
_GRAINS = ((0.25, 14.0), (0.09, 14.0), (0.035, 12.0))  # of surfaces that are not plain: metres, grey levels
_GREY_OF_FACE = (150, 190, 140, 200, 120, 165)  # -x +x -y +y -z +z: how light falls into the room


@dataclass(frozen=True)
class Room:
    """A room and the way of a camera in it."""

    solids: tuple[Solid, ...]
    cameras: tuple[Camera, ...]
    plain_view: int | None = None  # the camera all of whose view is plain, and nothing beside it; None: everything is


def make_room(seed: int, views: int, boxes: int = 3) -> Room:
    """A room of 3 to 6 m with a few boxes, and a camera that goes through it by less than half a metre a step."""
    rng = np.random.default_rng([seed, 11])
    length, width, height = rng.uniform((3.5, 3.0, 2.4), (6.5, 5.0, 3.0))
    walls = [
        ((length / 2, width / 2, -0.05), (length / 2, width / 2, 0.05)),
        ((length / 2, width / 2, height + 0.05), (length / 2, width / 2, 0.05)),
        ((-0.05, width / 2, height / 2), (0.05, width / 2, height / 2)),
        ((length + 0.05, width / 2, height / 2), (0.05, width / 2, height / 2)),
        ((length / 2, -0.05, height / 2), (length / 2, 0.05, height / 2)),
        ((length / 2, width + 0.05, height / 2), (length / 2, 0.05, height / 2)),
    ]
    solids = [_make_box(centre, half, 0.0, 1.0) for centre, half in walls]
    middle = np.array([length, width]) * rng.uniform(0.4, 0.6, 2)
    aim = np.array([length, width]) * rng.uniform(0.05, 0.25, 2)
    for _ in range(boxes):
        half = rng.uniform((0.15, 0.15, 0.2), (0.5, 0.4, 0.9))
        at = rng.uniform((0.3, 0.3), (0.55 * length, 0.55 * width))
        if np.linalg.norm(at - middle) > 1.3:
            solids.append(_make_box((*at, half[2]), half, rng.uniform(-40, 40), rng.uniform(0.7, 1.15)))
    heading, target = rng.uniform(0, 2 * np.pi), np.array([*aim, 0.9])
    centre, cameras = np.array([*middle, rng.uniform(1.1, 1.5)]), []
    K = np.array([[_FOCAL, 0.0, SIZE[0] / 2], [0.0, _FOCAL, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    for _ in range(views):
        cameras.append((look_at(centre, target, roll_deg=rng.normal(0.0, 1.5)), K))
        heading += rng.normal(0.0, 0.5)
        step = rng.uniform(0.15, 0.4)
        centre = centre + (step * np.cos(heading), step * np.sin(heading), rng.normal(0.0, 0.03))
        centre[:2] = np.clip(centre[:2], 0.25 * np.array([length, width]), 0.8 * np.array([length, width]))
        target = target + (*rng.normal(0.0, 0.25, 2), rng.normal(0.0, 0.08))
    return Room(tuple(solids), tuple(cameras))


def make_room_with_plain_view(seed: int, views: int, plain_view: int) -> Room:
    """A room in which one camera is turned to where walls are plain; what the others see beside that is not plain."""
    room, rng = make_room(seed, views), np.random.default_rng([seed, 77])
    cameras = list(room.cameras)
    T, K = cameras[plain_view]
    yaw_deg = rng.choice([-1, 1]) * rng.uniform(24, 32)
    turned = T.copy()
    turned[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ T[:3, :3]
    cameras[plain_view] = turned, K
    return replace(room, cameras=tuple(cameras), plain_view=plain_view)


def _paint(
    colours: npt.NDArray[np.uint8], z: npt.NDArray[np.float32], camera: Camera, plain: Camera, seed: int
) -> npt.NDArray[np.uint8]:
    """The picture of `camera` with patterns on what the camera `plain` does not see."""
    (T, K), (T_plain, K_plain) = camera, plain
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    points = (rays * np.where(np.isfinite(z), z, 1.0)[..., None]).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    seen = (points - T_plain[:3, 3]) @ T_plain[:3, :3]
    depth = np.maximum(seen[:, 2:], 1e-6)
    pixels = seen[:, :2] / depth * np.diag(K_plain)[:2] + K_plain[:2, 2]
    is_plain = (seen[:, 2] > 0) & (pixels > -8).all(1) & (pixels < np.array(SIZE) + 8).all(1)
    noise = np.random.default_rng(seed).normal(size=(32, 32, 32))
    patterns = np.zeros(len(points))
    for metres, grey in _GRAINS:
        patterns += grey * map_coordinates(noise, (points / metres).T % 32, order=1, mode="grid-wrap")
    painted = colours + np.where(is_plain, 0.0, patterns).reshape(*colours.shape[:2], 1)
    return np.clip(np.rint(painted), 0, 255).astype(np.uint8)


def photograph(room: Room, seed: int, camera: DepthCamera | None, tell_lens: bool = True) -> list[Frame]:
    """The photographs of the way, each with what the depth camera measured; without depth where there is none."""
    frames = []
    for index, each in enumerate(room.cameras):
        colours, z = cast(room.solids, each, *SIZE)
        if room.plain_view is not None:
            colours = _paint(colours, z, each, room.cameras[room.plain_view], seed)
        grain = np.random.default_rng([seed, 5, index]).normal(size=colours.shape)
        image = np.clip(np.rint(cv2.GaussianBlur(colours, (0, 0), 0.6) + grain), 0, 255).astype(np.uint8)
        K = each[1]
        lens = Intrinsics(*SIZE, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "calibration") if tell_lens else None
        depth = None if camera is None else measure(z, camera, index)
        frames.append(Frame(index, f"room_{index:03d}.png", index * 500_000_000, image, lens, depth=depth))
    return frames


def _make_box(centre: Sequence[float], half: Sequence[float], yaw_deg: float, light: float) -> Solid:
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    axes: npt.NDArray[np.float64] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) * np.asarray(half)
    skins = tuple(np.full((2, 2, 3), np.clip(light * grey, 0, 255), np.uint8) for grey in _GREY_OF_FACE)
    return Solid(Shape.BOX, axes, np.asarray(centre, np.float64), skins)
