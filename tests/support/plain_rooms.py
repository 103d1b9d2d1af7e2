"""Plain rooms: walls, a floor and boxes of one colour each, in which images have nothing to match and depth has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama import Camera, Shape, Solid, cast, look_at
from splatnode.capture.frame import Frame, Intrinsics
from tests.support.depth_camera import DepthCamera, measure

SIZE = (320, 240)
_FOCAL = 0.78 * SIZE[0]  # of an OAK's colour camera
_GREY_OF_FACE = (150, 190, 140, 200, 120, 165)  # -x +x -y +y -z +z: how light falls into the room


@dataclass(frozen=True)
class Room:
    """A room and the way of a camera in it."""

    solids: tuple[Solid, ...]
    cameras: tuple[Camera, ...]


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


def photograph(room: Room, seed: int, camera: DepthCamera | None, tell_lens: bool = True) -> list[Frame]:
    """The photographs of the way, each with what the depth camera measured; without depth where there is none."""
    frames = []
    for index, each in enumerate(room.cameras):
        colours, z = cast(room.solids, each, *SIZE)
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
