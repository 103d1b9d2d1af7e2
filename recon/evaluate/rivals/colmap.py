"""Stock COLMAP and GLOMAP through pycolmap (pip install 'splatnode[bench]'): photographs in, a sparse model out.

Everything is at its defaults, except that frames of one size share a camera, as they do in splatnode.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap

from splatnode.capture.frame import Frame, Intrinsics

Array = npt.NDArray[np.float64]
Mapper = Callable[[Path, int], Mapping[int, pycolmap.Reconstruction]]


@dataclass(frozen=True, eq=False)
class RegisteredFrame:
    """A frame with the camera that was found for it."""

    frame: Frame
    T_world_camera: Array  # (4, 4)
    intrinsics: Intrinsics


@dataclass(frozen=True, eq=False)
class Model:
    """The largest model. The world is the first registered camera's frame; the points' median depth there is 1."""

    registered: tuple[RegisteredFrame, ...]  # in the order of the frames
    points: Array  # (P, 3) world
    colours: npt.NDArray[np.uint8]  # (P, 3)
    observed: tuple[npt.NDArray[np.int64], ...]  # for each registered frame, the points that it observes


def incremental(folder: Path, seed: int) -> Mapping[int, pycolmap.Reconstruction]:
    """COLMAP's incremental mapper (Schönberger and Frahm 2016)."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    return pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder / "models", options)


def global_(folder: Path, seed: int) -> Mapping[int, pycolmap.Reconstruction]:
    """Global mapping after a calibration of the view graph, as GLOMAP does it (Pan et al. 2024)."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = seed
    pycolmap.calibrate_view_graph(folder / "database.db")
    return pycolmap.global_mapping(folder / "database.db", folder / "images", folder / "models", options)


def sparse_model(frames: Sequence[Frame], seed: int, mapping: Mapper = incremental) -> Model | None:
    """The largest model that `mapping` makes of the frames; None where it makes none."""
    if len(frames) < 2:
        return None
    with TemporaryDirectory(prefix="splatnode-rival-") as name:
        folder = Path(name)
        _prepare(folder, frames, seed)
        models = mapping(folder, seed)
        largest = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
        return None if largest is None else _model(largest, frames)


def _prepare(folder: Path, frames: Sequence[Frame], seed: int) -> None:
    """Images by size, features, and matches of all pairs, in `folder`/database.db."""
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value  # it reports every step
    pycolmap.set_random_seed(seed)
    (folder / "models").mkdir()
    groups: dict[str, list[int]] = {}
    for number, frame in enumerate(frames):
        path = folder / "images" / _image_name(number, frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        groups.setdefault(f"{frame.width}x{frame.height}", []).append(number)
    for members in groups.values():
        options = pycolmap.ImageReaderOptions()
        known = frames[members[0]].intrinsics
        if known is not None:
            options.camera_model = "SIMPLE_RADIAL"
            options.camera_params = f"{known.fx},{known.cx},{known.cy},0"
        pycolmap.extract_features(
            folder / "database.db",
            folder / "images",
            image_names=[_image_name(number, frames[number]) for number in members],
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=options,
            device=pycolmap.Device.cpu,
        )
    pycolmap.match_exhaustive(folder / "database.db", device=pycolmap.Device.cpu)


def _image_name(number: int, frame: Frame) -> str:
    return f"{frame.width}x{frame.height}/{number:04d}.png"


def _model(found: pycolmap.Reconstruction, frames: Sequence[Frame]) -> Model:
    by_name = {image.name: image for image in found.images.values() if image.has_pose}
    named = [(frame, by_name.get(_image_name(number, frame))) for number, frame in enumerate(frames)]
    images = [(frame, image) for frame, image in named if image is not None]
    Ts = np.stack([_inverse(image.cam_from_world().matrix()) for _, image in images])
    place = {point_id: row for row, point_id in enumerate(found.points3D)}
    points = np.array([point.xyz for point in found.points3D.values()], np.float64).reshape(-1, 3)
    observed = tuple(
        np.array([place[p.point3D_id] for p in image.points2D if p.has_point3D()], np.int64) for _, image in images
    )
    to_first = np.linalg.inv(Ts[0])
    Ts, points = to_first @ Ts, points @ to_first[:3, :3].T + to_first[:3, 3]
    depths = [(points[seen] - T[:3, 3]) @ T[:3, 2] for seen, T in zip(observed, Ts, strict=True)]
    scale = 1.0 / float(np.median(np.concatenate(depths)))
    Ts[:, :3, 3] *= scale
    return Model(
        tuple(
            RegisteredFrame(frame, T, _intrinsics(found.cameras[image.camera_id]))
            for (frame, image), T in zip(images, Ts, strict=True)
        ),
        scale * points,
        np.array([point.color for point in found.points3D.values()], np.uint8).reshape(-1, 3),
        observed,
    )


def _intrinsics(camera: pycolmap.Camera) -> Intrinsics:
    """OpenCV's first two radial coefficients are those of COLMAP's SIMPLE_RADIAL and RADIAL."""
    K = camera.calibration_matrix()
    radial = [float(camera.params[index]) for index in camera.extra_params_idxs()]
    distortion = (*radial, *[0.0] * (4 - len(radial))) if radial else ()
    return Intrinsics(camera.width, camera.height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "estimated", distortion)


def _inverse(T_camera_world: Array) -> Array:
    return np.linalg.inv(np.vstack([T_camera_world, [0.0, 0.0, 0.0, 1.0]]))
