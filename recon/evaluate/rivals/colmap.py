"""Stock COLMAP and GLOMAP through pycolmap (pip install 'splatnode[bench]'): photographs in, a sparse model out.

Everything is at its defaults, except that frames of one size share a camera, as they do in splatnode.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
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
    named = image_names(frames)
    with TemporaryDirectory(prefix="splatnode-rival-") as name:
        folder = Path(name)
        extract_features(folder, named, seed)
        pycolmap.match_exhaustive(folder / "database.db", device=pycolmap.Device.cpu)
        return largest_model(folder, named, seed, mapping)


def image_names(frames: Sequence[Frame]) -> dict[str, Frame]:
    """The frames by the names of their image files: a folder for each size."""
    return {f"{frame.width}x{frame.height}/{number:04d}.png": frame for number, frame in enumerate(frames)}


def extract_features(folder: Path, named: Mapping[str, Frame], seed: int) -> None:
    """Writes the images of the frames to `folder`/images, and their features to `folder`/database.db."""
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value  # it reports every step
    pycolmap.set_random_seed(seed)
    groups: dict[str, list[str]] = {}
    for name, frame in named.items():
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        groups.setdefault(name.split("/")[0], []).append(name)
    for members in groups.values():
        options = pycolmap.ImageReaderOptions()
        known = named[members[0]].intrinsics
        if known is not None:
            options.camera_model = "SIMPLE_RADIAL"
            options.camera_params = f"{known.fx},{known.cx},{known.cy},0"
        pycolmap.extract_features(
            folder / "database.db",
            folder / "images",
            image_names=members,
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=options,
            device=pycolmap.Device.cpu,
        )


def match_pairs(folder: Path, pairs: Iterable[tuple[str, str]]) -> None:
    """Matches these pairs of the images whose features `folder`/database.db holds."""
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = folder / "pairs.txt"
    (folder / "pairs.txt").write_text("".join(f"{first} {second}\n" for first, second in pairs))
    pycolmap.match_image_pairs(folder / "database.db", pairing_options=options, device=pycolmap.Device.cpu)


def part(folder: Path, names: Collection[str], into: Path) -> None:
    """Makes the folder `into` with a database of the images called `names` alone, as that in `folder` has them.

    Global mapping calibrates its whole database: it takes one that holds nothing else.
    """
    into.mkdir(parents=True)
    (into / "images").symlink_to(folder / "images")
    whole = pycolmap.Database.open(folder / "database.db")
    chosen = pycolmap.Database.open(into / "database.db")
    images = [image for image in whole.read_all_images() if image.name in names]
    cameras, frames = {image.camera_id for image in images}, {image.frame_id for image in images}
    for camera_id in sorted(cameras):
        chosen.write_camera(whole.read_camera(camera_id), use_camera_id=True)
    for rig in whole.read_all_rigs():
        if rig.ref_sensor_id.id in cameras:  # each camera is a rig of its own
            chosen.write_rig(rig, use_rig_id=True)
    for frame_id in sorted(frames):
        chosen.write_frame(whole.read_frame(frame_id), use_frame_id=True)
    for image in images:
        chosen.write_image(image, use_image_id=True)
        chosen.write_keypoints(image.image_id, whole.read_keypoints(image.image_id))
    for first, second in itertools.combinations(sorted(image.image_id for image in images), 2):
        if whole.exists_matches(first, second):
            chosen.write_matches(first, second, whole.read_matches(first, second))
        if whole.exists_two_view_geometry(first, second):
            chosen.write_two_view_geometry(first, second, whole.read_two_view_geometry(first, second))
    chosen.close()
    whole.close()


def largest_model(folder: Path, named: Mapping[str, Frame], seed: int, mapping: Mapper) -> Model | None:
    """The largest model that `mapping` makes of the images in `folder`/database.db, which are those of `named`.

    A model without points is none: it has no size.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(seed)
    (folder / "models").mkdir()
    models = mapping(folder, seed)
    solid = [model for model in models.values() if model.num_points3D() > 0]
    largest = max(solid, key=lambda model: model.num_reg_images(), default=None)
    return None if largest is None else _model(largest, named)


def _model(found: pycolmap.Reconstruction, named: Mapping[str, Frame]) -> Model:
    by_name = {image.name: image for image in found.images.values() if image.has_pose}
    images = [(frame, by_name[name]) for name, frame in named.items() if name in by_name]
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
