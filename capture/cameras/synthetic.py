"""The built-in capture: rendered hand-held photographs of a procedural place, with known cameras and depth.

The frames carry no intrinsics, as those of an unknown camera do, unless a lens is given, which they are then taken
through. What is known is for tests and benchmarks: scene_cameras, held_out_cameras and depth. The place is made by
splatnode.capture.diorama; this file photographs it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama import Camera, Matrix, Solid, cast, cast_through, look_at, odometry, place
from splatnode.capture.diorama import Config as Odometry
from splatnode.capture.frame import (
    Baseline,
    Clock,
    Frame,
    FramesPerSecond,
    Gravity,
    Intrinsics,
    Motion,
    RightImage,
    Stamp,
    grey,
)
from splatnode.capture.process.config import Internal

TARGET = np.array([1.05, 1.05, 0.82])  # what the photographer looks at: the table in the corner, metres


_RIGHT_SEED = 100_000  # of the noise of right images: not that of left ones

Count = Annotated[int, msgspec.Meta(ge=1)]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    views: Count = 8  # how many photographs are made
    width: Count = 640  # of an image, pixels
    height: Count = 480  # of an image, pixels
    seed: int = 0  # of the place and of the photographer's path
    noise: Internal[float] = 1.0  # standard deviation of the sensor noise, grey levels
    samples: Internal[Count] = 2  # rays a pixel in each direction
    fps: FramesPerSecond = 2.0  # by the stamps
    odometry: Internal[Odometry | None] = None  # of the camera, which photographs then carry; nothing: they carry none
    # That photographs are taken through, and carry; nothing: a pinhole's, unknown
    lens: Internal[Intrinsics | None] = None
    # Of a stereo camera, metres: what its right half sees goes with each photograph; nothing: there is but one camera
    baseline_m: Annotated[float, msgspec.Meta(gt=0, le=1)] | None = None


def stream(config: Config) -> Iterator[Frame]:
    """The photographs in the order of the path."""
    measured = simulate_odometry(config)
    for index, camera in enumerate(scene_cameras(config)):
        stamp_ns = round(index / config.fps * 1e9)
        image, captured_at = render_image(config, camera, index), Stamp(stamp_ns, Clock.RECORDING)
        right = None if config.baseline_m is None else _right_image(config, camera, index, config.baseline_m)
        frame = Frame(index, frame_name(index), stamp_ns, image, lens_of(config), captured_at=captured_at, right=right)
        yield replace(frame, motion=measured[index][0], gravity=measured[index][1]) if measured else frame


def simulate_odometry(config: Config) -> list[tuple[Motion, Gravity]]:
    """Simulates the motions of the stream's keyframes; returns nothing where no odometry is configured."""
    if config.odometry is None:
        return []
    Ts = [T for T, _ in scene_cameras(config)]
    return odometry([frame_name(index) for index in range(config.views)], Ts, config.odometry, config.seed)


def lens_of(config: Config) -> Intrinsics | None:
    """The lens of the photographs, for their size; None where none is given."""
    return None if config.lens is None else config.lens.resized(config.width, config.height)


def _bending_lens(config: Config) -> Intrinsics | None:
    """The lens of the photographs, where it bends lines; None for a pinhole."""
    lens = lens_of(config)
    return lens if lens is not None and (lens.distortion or lens.skew or lens.model != "opencv") else None


def frame_name(index: int) -> str:
    return f"view_{index:03d}.png"


def scene_cameras(config: Config) -> list[Camera]:
    """The cameras of the stream, in its order; world axes as in splatnode.capture.diorama."""
    return [_camera_on_path(config, float(index)) for index in range(config.views)]


def evaluation_cameras(config: Config) -> list[Camera]:
    """Cameras for testing: midway between each two neighbours of the stream."""
    return [_camera_on_path(config, index + 0.5) for index in range(config.views - 1)]


def video_cameras(config: Config, between: int) -> list[Camera]:
    """Cameras of a video on the same way: so many frames from each photograph of the stream to the next."""
    return [_camera_on_path(config, number / between) for number in range((config.views - 1) * between + 1)]


def render_image(config: Config, camera: Camera, noise_seed: int = 0) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB as `camera` sees the place of `config`: antialiased, with sensor noise."""
    T_world_camera, K = camera
    dense = config.width * config.samples, config.height * config.samples
    if (lens := _bending_lens(config)) is not None:
        colours, _ = cast_through(solids(config), T_world_camera, lens.resized(*dense))
    else:
        scale = np.diag([config.samples, config.samples, 1.0])
        colours, _ = cast(solids(config), (T_world_camera, scale @ K), *dense)
    image = cv2.resize(colours, (config.width, config.height), interpolation=cv2.INTER_AREA)
    grain = np.random.default_rng([config.seed, noise_seed]).normal(scale=config.noise, size=image.shape)
    return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)


def _right_image(config: Config, camera: Camera, index: int, baseline_m: float) -> RightImage:
    seen = render_image(config, offset_right_camera(camera, baseline_m), _RIGHT_SEED + index)
    return RightImage(grey(seen), Baseline(baseline_m))


def offset_right_camera(camera: Camera, baseline_m: float) -> Camera:
    """The right one of a stereo camera whose left one is `camera`: of the same axes and lens."""
    T_world_camera, K = camera
    beside = T_world_camera.copy()
    beside[:3, 3] += baseline_m * T_world_camera[:3, 0]
    return beside, K


def depth(config: Config, index: int) -> npt.NDArray[np.float32]:
    """(H, W) true z in the frame of the stream's camera `index`, metres, at pixel centres; inf where nothing is."""
    return depth_map(config, scene_cameras(config)[index])


def depth_map(config: Config, camera: Camera) -> npt.NDArray[np.float32]:
    """(H, W) true z in the frame of `camera`, metres, at pixel centres; inf where nothing is."""
    if (lens := _bending_lens(config)) is not None:
        return cast_through(solids(config), camera[0], lens)[1]
    return cast(solids(config), camera, config.width, config.height)[1]


def solids(config: Config) -> tuple[Solid, ...]:
    """The place, with about as many texels a metre as the images have samples. Made once, which takes seconds."""
    return place(
        config.seed, density=float(np.clip(0.25 * max(config.width, config.height) * config.samples, 64, 1024))
    )


def _camera_on_path(config: Config, position: float) -> Camera:
    """The photographer walks on an arc of at most 66 degrees around the corner, 11 a step, and holds the camera freely.

    Height, distance, aim and roll are smooth functions of the way, so that there is a camera at any `position`.
    """
    rng = np.random.default_rng([config.seed, 1])
    phases = rng.uniform(0, 2 * np.pi, 6)
    focal = rng.uniform(0.82, 0.95) * max(config.width, config.height)
    span = min(66.0, 11.0 * (config.views - 1))
    share = position / max(config.views - 1, 1)
    sway = np.sin(phases + 2.4 * position)  # quick against the arc: neighbours differ in height as well
    azimuth = np.radians(45 + span * (share - 0.5) + 0.8 * sway[0])
    distance = 3.35 + 0.20 * sway[1]
    height = 1.55 + 0.22 * sway[2]
    centre = np.array([TARGET[0] + distance * np.cos(azimuth), TARGET[1] + distance * np.sin(azimuth), height])
    target = TARGET + 0.07 * sway[3:6]
    lens = lens_of(config)
    return look_at(centre, target, roll_deg=2.5 * sway[4]), intrinsic_matrix(config, focal) if lens is None else lens.K


def intrinsic_matrix(config: Config, focal: float) -> Matrix:
    return np.array([[focal, 0.0, config.width / 2], [0.0, focal, config.height / 2], [0.0, 0.0, 1.0]])
