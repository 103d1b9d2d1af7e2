"""The built-in building: a robot's keyframes of a long walk through rooms and a corridor, made one by one.

The walk comes back to its rooms, walks the corridor both ways, and passes a mirror, two rooms that look alike, a chair
that is moved between two visits, and a few keyframes of blank wall. The photographs carry no intrinsics, as those of an
unknown camera do. What is known is for tests and benchmarks: scene_camera, held_out_camera, depth and shared_surface.
The place is made by splatnode.extras.building; this file photographs it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.scene import Camera
from splatnode.capture.frame import Clock, DroppedFrame, Frame, Stamp
from splatnode.capture.pace import FramesPerSecond, Pace, pace_frames
from splatnode.capture.process.config_keys import Internal
from splatnode.extras.building import walk as building_walk
from splatnode.extras.building.building import CHAIR_ROOM
from splatnode.extras.building.walk import CoarseView, Walk, compute_overlap, render_coarse_view, walk

SAME_PLACE = 0.3  # of what two keyframes show: as much in common, and they show the same place
BARE = 16.0  # texels a metre, where only surfaces matter: they are the same at every density, and soon made
LONGEST_KIDNAP = 400  # keyframes of the walk that a kidnapped robot may miss; the next tour of another room is nearer

Count = Annotated[int, msgspec.Meta(ge=1, le=100_000)]
Side = Annotated[int, msgspec.Meta(ge=16, le=4096)]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    keyframes: Count = 1000  # how many are made; the walk is as long as they need
    width: Internal[Side] = 480  # of an image, pixels
    height: Internal[Side] = 360  # of an image, pixels
    seed: Annotated[int, msgspec.Meta(ge=0, le=1_000_000)] = 0  # of the building and of the walk
    noise: Internal[float] = 1.0  # standard deviation of the sensor noise, grey levels
    samples: Internal[Annotated[int, msgspec.Meta(ge=1, le=4)]] = 2  # rays a pixel in each direction
    # The number of the keyframe from which on the robot is in another room; 0: it is never carried away
    kidnap_at: Annotated[int, msgspec.Meta(ge=0, le=100_000)] = 0
    fps: FramesPerSecond = 2.0  # by the stamps
    pace: Pace = "fastest"  # recorded: at the pace of the stamps; fastest: as fast as they are made


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """The photographs in the order of the walk, each made when it is asked for."""
    return pace_frames(_frames(config), config.pace)


def _frames(config: Config) -> Iterator[Frame]:
    for index in range(config.keyframes):
        stamp_ns = round(index / config.fps * 1e9)
        image, captured_at = render_image(config, index), Stamp(stamp_ns, Clock.RECORDING)
        yield Frame(index, frame_name(index), stamp_ns, image, intrinsics=None, captured_at=captured_at)


def frame_name(index: int) -> str:
    return f"keyframe_{index:05d}.png"


def frame_index(name: str) -> int:
    """Inverse of frame_name, of what begins with it, too."""
    return int(name.removeprefix("keyframe_").partition(".")[0])


def scene_camera(config: Config, index: float) -> Camera:
    """T_world_camera and K of a keyframe; world axes as in splatnode.extras.building.building, metres."""
    return _walk(config).T_world_camera(_position(config, index)), intrinsic_matrix(config)


def evaluation_camera(config: Config, index: int) -> Camera:
    """A camera for testing: midway on the walk from keyframe `index` to the next."""
    return scene_camera(config, index + 0.5)


def render_image(config: Config, index: float) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB as the camera of keyframe `index` (held out where it ends with .5) sees the building of then."""
    T_world_camera, K = scene_camera(config, index)
    dense = T_world_camera, np.diag([config.samples, config.samples, 1.0]) @ K
    colours = building_walk.view(
        state(config, index), dense, config.width * config.samples, config.height * config.samples
    )
    image = cv2.resize(colours, (config.width, config.height), interpolation=cv2.INTER_AREA)
    grain = np.random.default_rng([config.seed, round(2 * index)]).standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + np.float32(config.noise) * grain), 0, 255).astype(np.uint8)


def depth(config: Config, index: float) -> npt.NDArray[np.float32]:
    """(H, W) true z in the keyframe's camera frame, metres, at pixel centres; of the mirror, that of its glass."""
    return building_walk.depth(state(config, index), scene_camera(config, index), config.width, config.height)


def measure_shared_surface(config: Config, first: int, second: int) -> float:
    """0 to 1: how much of the surface that one keyframe shows the other shows, too; of both ways the lesser."""
    return compute_overlap(_render_coarse_view(config, first), _render_coarse_view(config, second))


def same_place(config: Config, first: int, second: int) -> bool:
    """Whether two keyframes show the same place. A chair that was moved in between makes no other place of it."""
    return measure_shared_surface(config, first, second) >= SAME_PLACE


def state(config: Config, index: float) -> building_walk.BuildingState:
    """The building when a keyframe is taken: the chair is moved whenever its room has been left."""
    position = _position(config, index)
    left = sum(visit.room == CHAIR_ROOM and visit.last < position for visit in _walk(config).visits)
    density = float(np.clip(0.28 * max(config.width, config.height), 48, 512))
    return building_walk.BuildingState(config.seed, density, left % 2)


def room(config: Config, index: float) -> int | None:
    """The room that is toured at a keyframe; None on the way between two."""
    visit = _walk(config).visit_at(_position(config, index))
    return None if visit is None else visit.room


def intrinsic_matrix(config: Config) -> npt.NDArray[np.float64]:
    """(3, 3); 71 degrees from left to right."""
    focal = 0.7 * config.width
    return np.array([[focal, 0.0, config.width / 2], [0.0, focal, config.height / 2], [0.0, 0.0, 1.0]])


def _walk(config: Config) -> Walk:
    return walk(config.seed, config.keyframes + LONGEST_KIDNAP)


def _position(config: Config, index: float) -> float:
    if not config.kidnap_at or index < config.kidnap_at:
        return index
    return index + _count_missed_keyframes(config)


@lru_cache(maxsize=8)
def _count_missed_keyframes(config: Config) -> float:
    """Keyframes that the kidnapped robot misses: it goes on in the middle of the next tour of another room."""
    here = _walk(config).visit_at(config.kidnap_at)
    for visit in _walk(config).visits:
        middle = (visit.first + visit.last) / 2
        if middle > config.kidnap_at and (here is None or visit.room != here.room):
            return round(middle - config.kidnap_at)
    raise ValueError(f"no other room is toured after keyframe {config.kidnap_at}; kidnap the robot earlier")


@lru_cache(maxsize=4096)
def _render_coarse_view(config: Config, index: int) -> CoarseView:
    bare = replace(state(config, index), density=BARE)
    return render_coarse_view(bare, scene_camera(config, index), config.width, config.height)
