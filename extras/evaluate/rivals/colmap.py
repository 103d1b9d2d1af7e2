"""Stock COLMAP and GLOMAP through pycolmap (pip install 'splatnode[bench]'): photographs in, a sparse model out.

Everything is at its defaults, except that frames of one size share a camera, as they do in splatnode. `..._few_views`
are the same mappers with options for few views: their defaults are made for hundreds.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap

from splatnode.capture.frame import Frame, Intrinsics

Array = npt.NDArray[np.float64]
Mapper = Callable[[Path, int], Mapping[int, pycolmap.Reconstruction]]
Pair = tuple[str, str]  # of images, by their names


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """The features of an image."""

    keypoints: npt.NDArray[np.float32]
    descriptors: Any  # pycolmap.FeatureDescriptors, which older releases do not have


@dataclass(frozen=True, eq=False)
class PairMatches:
    """The matches of two images, and what they agree on."""

    matches: npt.NDArray[np.uint32]
    geometry: pycolmap.TwoViewGeometry


NOTHING_KNOWN: Mapping[str, ImageFeatures] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class RegisteredFrame:
    """A frame with the camera that was found for it."""

    frame: Frame
    T_world_camera: Array  # (4, 4)
    intrinsics: Intrinsics


@dataclass(frozen=True, eq=False)
class SparseModel:
    """The largest model. The world is the first registered camera's frame; the points' median depth there is 1."""

    registered: tuple[RegisteredFrame, ...]  # in the order of the frames
    points: Array  # (P, 3) world
    colours: npt.NDArray[np.uint8]  # (P, 3)
    observed: tuple[npt.NDArray[np.int64], ...]  # for each registered frame, the points that it observes


def map_incrementally(folder: Path, seed: int) -> Mapping[int, pycolmap.Reconstruction]:
    """COLMAP's incremental mapper (Schönberger and Frahm 2016)."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    return pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder / "models", options)


def map_globally(folder: Path, seed: int) -> Mapping[int, pycolmap.Reconstruction]:
    """Global mapping after a calibration of the view graph, as GLOMAP does it (Pan et al. 2024)."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = seed
    pycolmap.calibrate_view_graph(folder / "database.db")
    return pycolmap.global_mapping(folder / "database.db", folder / "images", folder / "models", options)


def map_few_views_incrementally(folder: Path, seed: int) -> Mapping[int, pycolmap.Reconstruction]:
    """COLMAP's incremental mapper with what it needs where images are few, and far apart or close together.

    A first pair may have 1 degree between its rays, 50 inliers and forward motion; points need .5 degrees, a further
    image 15 inliers; no distortion is estimated, for images have none.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.mapper.init_min_tri_angle = 1.0
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_num_inliers = 50
    options.mapper.abs_pose_min_num_inliers = 15
    options.mapper.filter_min_tri_angle = 0.5
    options.mapper.abs_pose_refine_extra_params = False
    options.triangulation.min_angle = 0.5
    options.ba_refine_extra_params = False
    return pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder / "models", options)


def map_few_views_globally(folder: Path, seed: int) -> Mapping[int, pycolmap.Reconstruction]:
    """GLOMAP with points that two views see, which need .5 degrees, and without distortion."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = seed
    options.mapper.track_min_num_views_per_track = 2
    options.mapper.global_positioning.min_num_view_per_track = 2
    options.mapper.bundle_adjustment.min_track_length = 2
    options.mapper.bundle_adjustment.refine_extra_params = False
    options.mapper.min_tri_angle_deg = 0.5
    options.mapper.retriangulation.min_angle = 0.5
    options.mapper.retriangulation.ignore_two_view_tracks = False
    pycolmap.calibrate_view_graph(folder / "database.db")
    return pycolmap.global_mapping(folder / "database.db", folder / "images", folder / "models", options)


MAPPERS: Mapping[str, Mapper] = {
    "colmap": map_incrementally,
    "colmap-few-views": map_few_views_incrementally,
    "glomap": map_globally,
    "glomap-few-views": map_few_views_globally,
}


def reconstruct_sparse_model(
    frames: Sequence[Frame], seed: int, mapping: Mapper = map_incrementally
) -> SparseModel | None:
    """The largest model that `mapping` makes of the frames; None where it makes none."""
    if len(frames) < 2:
        return None
    named = name_images(frames)
    with TemporaryDirectory(prefix="splatnode-rival-") as name:
        folder = Path(name)
        extract_features(folder, named, seed)
        pycolmap.match_exhaustive(folder / "database.db", device=pycolmap.Device.cpu)
        return map_largest_model(folder, named, seed, mapping)


def name_images(frames: Sequence[Frame]) -> dict[str, Frame]:
    """The frames by the names of their image files: a folder for each size."""
    return {f"{frame.width}x{frame.height}/{number:04d}.png": frame for number, frame in enumerate(frames)}


def extract_features(
    folder: Path, named: Mapping[str, Frame], seed: int, known: Mapping[str, ImageFeatures] = NOTHING_KNOWN
) -> None:
    """Writes the images of the frames to `folder`/images, and their features to `folder`/database.db.

    Features that are `known`, by the image's name, are not sought again.
    """
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
        lens = named[members[0]].intrinsics
        if lens is not None:
            options.camera_model = "SIMPLE_RADIAL"
            options.camera_params = f"{lens.fx},{lens.cx},{lens.cy},0"
        images = {"database_path": folder / "database.db", "image_path": folder / "images", "image_names": members}
        one_camera = pycolmap.CameraMode.PER_FOLDER
        if known:
            pycolmap.Database.open(folder / "database.db").close()  # it must be there
            pycolmap.import_images(**images, camera_mode=one_camera, options=options)
            _write_features(folder, {name: known[name] for name in members if name in known})
        pycolmap.extract_features(**images, camera_mode=one_camera, reader_options=options, device=pycolmap.Device.cpu)


def match_pairs(folder: Path, pairs: Sequence[Pair], seed: int, known: Mapping[Pair, PairMatches]) -> None:
    """Matches these pairs of the images whose features `folder`/database.db holds, but for those that are `known`.

    What comes of a pair depends on no other one.
    """
    with _open_database(folder) as (database, ids):
        for (first, second), found in known.items():
            database.write_matches(ids[first], ids[second], found.matches)
            database.write_two_view_geometry(ids[first], ids[second], found.geometry)
    pairing, verifying = pycolmap.ImportedPairingOptions(), pycolmap.TwoViewGeometryOptions()
    pairing.match_list_path = folder / "pairs.txt"
    verifying.ransac.random_seed = seed
    pairing.match_list_path.write_text(
        "".join(f"{first} {second}\n" for first, second in pairs if (first, second) not in known)
    )
    pycolmap.match_image_pairs(
        folder / "database.db", pairing_options=pairing, verification_options=verifying, device=pycolmap.Device.cpu
    )


def read_features(folder: Path, names: Collection[str]) -> dict[str, ImageFeatures]:
    """Reads the features of these images from `folder`/database.db."""
    with _open_database(folder) as (database, ids):
        return {
            name: ImageFeatures(database.read_keypoints(ids[name]), database.read_descriptors(ids[name]))
            for name in names
        }


def read_matches(folder: Path, pairs: Collection[Pair]) -> dict[Pair, PairMatches]:
    """Reads the matches of these pairs of images from `folder`/database.db."""
    with _open_database(folder) as (database, ids):
        return {
            (first, second): PairMatches(
                database.read_matches(ids[first], ids[second]), database.read_two_view_geometry(ids[first], ids[second])
            )
            for first, second in pairs
        }


def _write_features(folder: Path, known: Mapping[str, ImageFeatures]) -> None:
    with _open_database(folder) as (database, ids):
        for name, found in known.items():
            database.write_keypoints(ids[name], found.keypoints)
            database.write_descriptors(ids[name], found.descriptors)


@contextlib.contextmanager
def _open_database(folder: Path) -> Iterator[tuple[pycolmap.Database, dict[str, int]]]:
    """The database of a folder, and the numbers of its images by their names."""
    database = pycolmap.Database.open(folder / "database.db")
    try:
        yield database, {image.name: image.image_id for image in database.read_all_images()}
    finally:
        database.close()


def map_largest_model(folder: Path, named: Mapping[str, Frame], seed: int, mapping: Mapper) -> SparseModel | None:
    """The largest model that `mapping` makes of the images in `folder`/database.db, which are those of `named`.

    A model without points is none: it has no size.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(seed)
    (folder / "models").mkdir()
    models = mapping(folder, seed)
    solid = [model for model in models.values() if model.num_points3D() > 0]
    largest = max(solid, key=lambda model: model.num_reg_images(), default=None)
    return None if largest is None else _convert_model(largest, named)


def _convert_model(found: pycolmap.Reconstruction, named: Mapping[str, Frame]) -> SparseModel:
    by_name = {image.name: image for image in found.images.values() if image.has_pose}
    images = [(frame, by_name[name]) for name, frame in named.items() if name in by_name]
    Ts = np.stack([_invert_pose(image.cam_from_world().matrix()) for _, image in images])
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
    return SparseModel(
        tuple(
            RegisteredFrame(frame, T, _convert_intrinsics(found.cameras[image.camera_id]))
            for (frame, image), T in zip(images, Ts, strict=True)
        ),
        scale * points,
        np.array([point.color for point in found.points3D.values()], np.uint8).reshape(-1, 3),
        observed,
    )


def _convert_intrinsics(camera: pycolmap.Camera) -> Intrinsics:
    """OpenCV's first two radial coefficients are those of COLMAP's SIMPLE_RADIAL and RADIAL."""
    K = camera.calibration_matrix()
    radial = [float(camera.params[index]) for index in camera.extra_params_idxs()]
    distortion = (*radial, *[0.0] * (4 - len(radial))) if radial else ()
    return Intrinsics(camera.width, camera.height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "estimated", distortion)


def _invert_pose(T_camera_world: Array) -> Array:
    return np.linalg.inv(np.vstack([T_camera_world, [0.0, 0.0, 0.0, 1.0]]))
