"""Scenes with known cameras, as they lie on disk. What is read here must never reach a reconstruction.

COLMAP's sparse model, text or binary, gives the cameras of its photographs; points are not read. It is read here and
not by pycolmap, which takes memory for every count that a file states. The built-in capture is written in the same
layout.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.cameras.folder import frame_name, image_paths
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.image_file import (
    SUFFIXES,
    UnusableImage,
    decode_any_image,
    encode_png,
    read_image_file,
    upright_size,
)
from splatnode.capture.masks import mask_frames, open_masks
from splatnode.capture.pose_files import binary_images, content_lines, text_images
from splatnode.capture.process.config import record_in
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.text import LONGEST_TEXT, guard_untrusted, sanitize_text
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.export.stored import Number, Row3, Row4, encode_cameras
from splatnode.recon.result.placement import matrices_from_quats
from splatnode.recon.result.snapshot import CameraEstimate, find_camera_problem
from splatnode.recon.threads import map_parallel

# JSON files of evaluations: true cameras, splits, raw results.

T = TypeVar("T")

MAX_BYTES = 500_000_000


class EvaluationFileError(ValueError):
    """A file of an evaluation that is not what it should be; the message names it."""


def read_json(path: Path, kind: type[T], expected: str) -> T:
    """The content of `path`, which must be `expected`, as a `kind`; numbers are finite.

    Raises EvaluationFileError, OSError.
    """
    with guard_untrusted(EvaluationFileError, str(path)):
        try:
            return record_in(read_bounded(path, MAX_BYTES, EvaluationFileError, str(path)), kind)
        except msgspec.MsgspecError as error:
            raise EvaluationFileError(f"{path} must be {expected}: {error}") from error


_PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}  # parameters of each
_NUMBERS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE"}


@dataclass(frozen=True)
class ColmapCamera:
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class ColmapImage:
    name: str
    quat: tuple[float, float, float, float]  # wxyz, of T_camera_world
    translation: tuple[float, float, float]
    camera: ColmapCamera


def read_model(folder: Path) -> list[ColmapImage]:
    """The photographs of the model in `folder`.

    Raises EvaluationFileError where it is none, or is of distorted photographs; OSError.
    """
    suffix = "bin" if (folder / "cameras.bin").exists() else "txt"
    cameras_file, images_file = _read_content(folder / f"cameras.{suffix}"), _read_content(folder / f"images.{suffix}")
    with guard_untrusted(EvaluationFileError, str(folder)):
        try:
            cameras = dict(
                _parse_binary_cameras(cameras_file) if suffix == "bin" else _parse_text_cameras(cameras_file.decode())
            )
            images = binary_images(images_file) if suffix == "bin" else text_images(images_file.decode())
            return [
                ColmapImage(name, (w, x, y, z), (tx, ty, tz), cameras[camera_id])
                for name, (w, x, y, z, tx, ty, tz), camera_id in images
            ]
        except KeyError as error:
            raise EvaluationFileError(f"{folder}: a photograph has the camera {error}, which is not there") from error
        except (ValueError, struct.error) as error:
            raise EvaluationFileError(f"{folder} must be a COLMAP model of undistorted photographs: {error}") from error


def _read_content(path: Path) -> bytes:
    return read_bounded(path, MAX_BYTES, EvaluationFileError, str(path))


def _make_camera(model: str, width: int, height: int, lens: tuple[float, ...]) -> ColmapCamera:
    if model not in _PINHOLES or len(lens) != _PINHOLES[model]:
        raise ValueError(f"a camera is {sanitize_text(model, 100)} with {len(lens)} parameters, not PINHOLE with 4")
    fx, fy, cx, cy = lens if len(lens) == 4 else (lens[0], *lens)
    return ColmapCamera(width, height, fx, fy, cx, cy)


def _parse_text_cameras(text: str) -> Iterator[tuple[int, ColmapCamera]]:
    for line in content_lines(text):
        if line.strip():
            number, model, width, height, *lens = line.split()
            yield int(number), _make_camera(model, int(width), int(height), tuple(map(float, lens)))


def _parse_binary_cameras(data: bytes) -> Iterator[tuple[int, ColmapCamera]]:
    (count,), position = struct.unpack_from("<Q", data), 8
    for _ in range(count):  # ends at the latest where the bytes do
        number, model, width, height = struct.unpack_from("<IiQQ", data, position)
        size = _PINHOLES.get(_NUMBERS.get(model, ""), 0)
        lens = struct.unpack_from(f"<{size}d", data, position + 24)
        yield number, _make_camera(_NUMBERS.get(model, f"of model {model}"), width, height, lens)
        position += 24 + 8 * size


# True cameras from the files in which data sets have them: cameras.json, transforms.json, COLMAP's models.

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

Array: TypeAlias = npt.NDArray[np.float64]
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=LONGEST_TEXT)]


@dataclass(frozen=True, eq=False)
class TrueCamera:
    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3) for an image `width` x `height`
    width: int
    height: int

    def size_problem(self, width: int, height: int) -> str:
        """Why no photograph of this size is the camera's, resized; empty where one may be. Sides may be rounded."""
        off = abs(self.width * height - self.height * width)
        if off <= max(self.width, self.height, width, height):
            return ""
        declared = f"declared {self.width} x {self.height}"
        return f"{declared}, the photograph is {width} x {height} (after its EXIF orientation)"

    def K_for(self, width: int, height: int) -> npt.NDArray[np.float64]:
        """K of the image resized to `width` x `height`."""
        return self.K * np.array([width / self.width, height / self.height, 1.0])[:, None]

    def intrinsics_for(self, width: int, height: int) -> Intrinsics:
        """Returns the given intrinsics of the image resized to `width` x `height`."""
        K = self.K_for(width, height)
        return Intrinsics(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "given")


class _ImageRecord(msgspec.Struct, frozen=True):
    """An image of a recorded data set's cameras.json; the camera of some is unknown."""

    name: Text
    R: tuple[Row3, Row3, Row3] | None = None  # of T_camera_world
    t: Row3 | None = None
    K: tuple[Row3, Row3, Row3] | None = None
    width: int = 0
    height: int = 0


class _CamerasJson(msgspec.Struct, frozen=True):
    cameras: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET  # ours
    images: tuple[_ImageRecord, ...] | None = None


class _Lens(msgspec.Struct, frozen=True):
    """The lens that transforms.json gives for all images, or for one."""

    w: Number | None = None
    h: Number | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    p1: Number | None = None
    p2: Number | None = None


class _TransformsFrame(_Lens, frozen=True, kw_only=True):
    file_path: Text
    transform_matrix: tuple[Row4, Row4, Row4, Row4] | None = None


class _TransformsJson(_Lens, frozen=True, kw_only=True):
    frames: tuple[_TransformsFrame, ...]


def read_true_cameras(path: Path) -> dict[str, TrueCamera]:
    """Reads cameras by image name; `path` is cameras.json, transforms.json or a model's folder.

    Raises EvaluationFileError or SceneFileError, which name the file, where it is something else, or where a camera is
    no rigid motion or no pinhole; OSError.
    """
    readers = {"cameras.json": _read_cameras_json, "transforms.json": _read_transforms_json}
    with guard_untrusted(EvaluationFileError, str(path)):
        cameras: dict[str, TrueCamera] = {}
        for name, camera in readers.get(path.name, _read_colmap)(path):
            problem = find_camera_problem(camera.T_world_camera, camera.K, camera.width, camera.height)
            problem = problem or ("there are two cameras of this name" if name in cameras else "")
            if problem:
                raise EvaluationFileError(f"{path}, {sanitize_text(name, 100)}: {problem}")
            cameras[name] = camera
        return cameras


def _read_cameras_json(path: Path) -> Iterable[tuple[str, TrueCamera]]:
    content = read_json(path, _CamerasJson, "the cameras of a scene")
    if content.cameras is not msgspec.UNSET:
        for camera in read_cameras(path):
            yield camera.name, TrueCamera(camera.T_world_camera, camera.K, camera.width, camera.height)
        return
    if content.images is None:
        raise EvaluationFileError(f"{path} must have a list 'cameras' or 'images'")
    for image in content.images:
        if image.R is None:
            continue
        if image.t is None or image.K is None:
            raise EvaluationFileError(f"{path} must give R, t and K for {sanitize_text(image.name)}")
        yield (
            image.name,
            _make_true_camera(
                f"{path}, {sanitize_text(image.name, 100)}",
                np.array(image.R),
                image.t,
                np.array(image.K),
                image.width,
                image.height,
            ),
        )


def _read_transforms_json(path: Path) -> Iterable[tuple[str, TrueCamera]]:
    content = read_json(path, _TransformsJson, "a transforms.json of nerfstudio")
    for view in content.frames:
        view_values = {key: getattr(view, key) for key in _Lens.__struct_fields__}
        values = {key: getattr(content, key) if value is None else value for key, value in view_values.items()}
        shown = sanitize_text(view.file_path)
        missing = [key for key in ("w", "h", "fl_x") if values[key] is None]
        missing += ["transform_matrix"] if view.transform_matrix is None else []
        if missing:
            raise EvaluationFileError(f"{path} must give {', '.join(missing)} for {shown}")
        distortion = {key: values[key] for key in _DISTORTION if values[key]}
        if distortion:
            raise EvaluationFileError(f"{path} must be of undistorted images, {shown} has {distortion}")
        width, height, fx = int(values["w"]), int(values["h"]), values["fl_x"]
        fy = fx if values["fl_y"] is None else values["fl_y"]
        cx, cy = (half if values[key] is None else values[key] for key, half in (("cx", width / 2), ("cy", height / 2)))
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        T_world_camera = np.array(view.transform_matrix) @ _OPENGL
        yield Path(view.file_path).name, TrueCamera(T_world_camera, K, width, height)


def _read_colmap(path: Path) -> Iterable[tuple[str, TrueCamera]]:
    for image in read_model(path):
        lens = image.camera
        K = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
        with np.errstate(invalid="ignore"):  # a quaternion of zeros is no rotation, which is found below
            rotation = matrices_from_quats(image.quat)
        where = f"{path}, {sanitize_text(image.name, 100)}"
        yield Path(image.name).name, _make_true_camera(where, rotation, image.translation, K, lens.width, lens.height)


def _make_true_camera(
    where: str, rotation: Array, translation: Iterable[float], K: Array, width: int, height: int
) -> TrueCamera:
    """From the rotation and the translation of T_camera_world."""
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], T_camera_world[:3, 3] = rotation, tuple(translation)
    problem = find_camera_problem(T_camera_world, K, width, height)
    if problem:
        raise EvaluationFileError(f"{where}: {problem.replace('T_world_camera', 'T_camera_world')}")
    return TrueCamera(np.linalg.inv(T_camera_world).astype(np.float64), K, width, height)


_CHOSEN = "24_views"  # of InstantSplat's data sets: the frames that its protocol uses


@dataclass(frozen=True, eq=False)
class EvaluationScene:
    """Images by name in their order, and the true cameras of those that have one."""

    name: str
    paths: Mapping[str, Path]
    cameras: Mapping[str, TrueCamera]
    masks: Path | None = None  # a folder; None: all of every image is used

    def image(self, name: str) -> npt.NDArray[np.uint8]:
        """(H, W, 3) RGB. Raises EvaluationFileError where it is no image, or none of its true camera; OSError."""
        path = self.paths[name]
        try:
            image = decode_any_image(read_image_file(path))[0]
        except UnusableImage as error:
            raise EvaluationFileError(f"{path} must be an image: {error}") from error
        _check_size(path, self.cameras.get(name), (image.shape[1], image.shape[0]))
        return image

    def frames(self, names: Sequence[str]) -> list[Frame]:
        """Loads what a reconstruction gets: images in the given order, nothing known about the camera.

        Without those of which a mask leaves hardly anything. Raises as `image`, and UnusableMask.
        """
        found = [Frame(i, name, i, self.image(name), None) for i, name in enumerate(names)]
        if self.masks is None:
            return found
        return [each for each in mask_frames(found, open_masks(self.masks)) if isinstance(each, Frame)]

    def load_masked_image(self, name: str) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        """(H, W, 3) RGB, filled where it is not used, and (H, W) where it is: nowhere, where hardly anything is.

        Raises as `image`, and UnusableMask.
        """
        found = self.frames([name])
        if not found:
            image = self.image(name)
            return image, np.zeros(image.shape[:2], bool)
        (frame,) = found
        return frame.image, np.ones(frame.image.shape[:2], bool) if frame.mask is None else frame.mask


def load_scene(folder: Path) -> EvaluationScene:
    """The scene in `folder`: images/ and one of cameras.json, transforms.json or sparse/0, in this order.

    Images are in natural order (frame_2 before frame_10); hidden files are none.
    cameras.json is ours ("cameras": T_world_camera) or that of recorded data sets ("images": R, t); transforms.json is
    nerfstudio's; sparse/0 is a COLMAP model, text or binary. Tanks and Temples and MVImgNet as InstantSplat gives them
    have all that in a folder 24_views of the scene's, which is found from either. Images must be undistorted. What a
    folder masks/ hides of them (black; white is used) is neither reconstructed nor scored. Raises
    FileNotFoundError where a part is missing, EvaluationFileError or SceneFileError (both ValueErrors, which name the
    file) where it cannot be what it should be, where all cameras are of other photographs, or a photograph has another
    shape than its true camera's pictures.
    """
    place = find_scene_folder(folder)
    data = place / _CHOSEN if (place / _CHOSEN).is_dir() else place
    photographs = image_paths(data / "images") if (data / "images").is_dir() else []
    paths = {frame_name(path): path for path in photographs if path.suffix.lower() in SUFFIXES}
    if not paths:
        raise FileNotFoundError(f"{data / 'images'} must hold the scene's images; there are none")
    sources = ("cameras.json", "transforms.json", "sparse/0")
    for source in sources:
        if (data / source).exists():
            cameras = read_true_cameras(data / source)
            known = {name: cameras[path.name] for name, path in paths.items() if path.name in cameras}
            if cameras and not known:
                example = f"such as {sanitize_text(min(cameras), 100)}, there is {next(iter(paths))}"
                raise EvaluationFileError(
                    f"no photograph in {data / 'images'} has a camera in {data / source}, {example}"
                )
            for name, camera in known.items():
                _check_size(paths[name], camera, _read_size(paths[name]))
            masks = data / "masks" if (data / "masks").is_dir() else None
            return EvaluationScene(place.name, paths, known, masks)
    raise FileNotFoundError(f"{data} must hold the true cameras as one of {', '.join(sources)}; there is none")


def _read_size(path: Path) -> tuple[int, int] | None:
    """Width and height of a photograph; None where its file does not tell: what is wrong with it, `image` says."""
    try:
        return upright_size(read_image_file(path))
    except UnusableImage:
        return None


def _check_size(path: Path, camera: TrueCamera | None, size: tuple[int, int] | None) -> None:
    problem = camera.size_problem(*size) if camera and size else ""
    if problem:
        raise EvaluationFileError(f"{path}: {problem}")


def check_distinct_names(folders: Sequence[Path]) -> None:
    """Raises ValueError where two of the folders hold scenes of one name, or are one: by it what is found is kept."""
    known: dict[str, tuple[Path, Path]] = {}
    for folder in folders:
        place = find_scene_folder(Path(os.path.abspath(folder)))
        if place.name in known:
            other, before = known[place.name]
            why = "are one scene" if before == place else f"are both called {place.name!r}, which tells scenes apart"
            raise ValueError(f"the scenes {str(other)!r} and {str(folder)!r} {why}: leave out one, or rename it")
        known[place.name] = folder, place


def find_scene_folder(folder: Path) -> Path:
    """The folder with the scene's name, where `folder` may be the one of its chosen frames."""
    return folder.parent if folder.name == _CHOSEN else folder


# Which views of a scene train a reconstruction and which test it.

_PAPER_FRAMES, _PAPER_TEST = 24, 12


@dataclass(frozen=True)
class Split:
    train: tuple[str, ...]
    test: tuple[str, ...]


def load_split(folder: Path, names: Sequence[str], views: int) -> Split:
    """The split of the scene in `folder` for `views` training images.

    It is that of the splits.json beside the scene's folder where that lists the scene, else the paper's of `names`.
    Raises ValueError, which names the scene, where there is no such split, where it lists photographs that are not
    among `names`, and where it lists one twice: what trains must not test.
    """
    place = find_scene_folder(folder)
    listed = place.parent / "splits.json"
    splits: dict[str, dict[str, list[str]]] = {}
    if listed.is_file():
        splits = read_json(listed, dict[str, dict[str, list[str]]], "lists of photographs by scene and split")
    if not names:
        raise ValueError(f"{place.name} must have photographs with a true camera, there are none")
    if place.name not in splits:
        try:
            return make_paper_split(names, views)
        except ValueError as error:
            raise ValueError(f"{place.name}: {error}") from error
    split = splits[place.name]
    if not {f"train{views}", "test"} <= split.keys():
        raise ValueError(f"{listed} must list train{views} and test for {place.name}, has {sorted(split)}")
    found = Split(tuple(split[f"train{views}"]), tuple(split["test"]))
    _check_names(found, names, f"{listed}, train{views} and test of {place.name}")
    return found


def _check_names(split: Split, names: Sequence[str], where: str) -> None:
    listed = (*split.train, *split.test)
    if absent := sorted(set(listed) - set(names)):
        raise ValueError(f"{where} must be of photographs with a true camera; these are not: {_format_names(absent)}")
    if twice := sorted(name for name, times in Counter(listed).items() if times > 1):
        raise ValueError(f"{where} must list each photograph once; these are there twice: {_format_names(twice)}")


def _format_names(names: Sequence[str]) -> str:
    return ", ".join(sanitize_text(name, 100) for name in names[:5]) + (" and more" if len(names) > 5 else "")


def make_paper_split(names: Sequence[str], views: int) -> Split:
    """The split of InstantSplat and of the paper: of 24 frames 12 test, without the first and the last.

    The training views are spread evenly over the rest. More than 24 frames are thinned evenly to 24; of fewer, half
    test.
    """
    if len(names) > _PAPER_FRAMES:
        return make_paper_split([names[i] for i in _space_evenly(0, len(names) - 1, _PAPER_FRAMES)], views)
    num_test = min(_PAPER_TEST, len(names) // 2)
    test = sorted(set(_space_evenly(1, len(names) - 2, num_test)))
    rest = [i for i in range(len(names)) if i not in test]
    if not 1 <= views <= len(rest):
        raise ValueError(f"views must be 1 to {len(rest)} for {len(names)} images, got {views}")
    train = [rest[i] for i in _space_evenly(0, len(rest) - 1, views)]
    return Split(tuple(names[i] for i in train), tuple(names[i] for i in test))


def _space_evenly(first: int, last: int, count: int) -> list[int]:
    return np.linspace(first, last, count).astype(int).tolist()


def write_capture(folder: Path, place: synthetic.Config) -> Split:
    """Writes the photographs, those held out for testing, and the true cameras of both; returns their names.

    The cameras are for evaluation: reconstruction reads the photographs in `folder`/images and nothing else.
    """
    split = write_training_images(folder, place)
    write_held_out_images(folder, place)
    return split


def write_training_images(folder: Path, place: synthetic.Config) -> Split:
    """Writes the photographs that are reconstructed; returns the names of all."""
    training = _list_training_cameras(place)
    _write_images(folder, place, training, first=0)
    return Split(tuple(training), tuple(_list_test_cameras(place)))


def write_held_out_images(folder: Path, place: synthetic.Config) -> None:
    """Writes the photographs held out for testing, and the true cameras of all."""
    training, testing = _list_training_cameras(place), _list_test_cameras(place)
    _write_images(folder, place, testing, first=len(training))
    cameras = [
        CameraEstimate(name, number, T_world_camera, K, place.width, place.height)
        for number, (name, (T_world_camera, K)) in enumerate({**training, **testing}.items())
    ]
    write_files(folder, {"cameras.json": encode_cameras(cameras)})


def _list_training_cameras(place: synthetic.Config) -> dict[str, synthetic.Camera]:
    return {synthetic.frame_name(i): camera for i, camera in enumerate(synthetic.scene_cameras(place))}


def _list_test_cameras(place: synthetic.Config) -> dict[str, synthetic.Camera]:
    return {f"test_{i:03d}.png": camera for i, camera in enumerate(synthetic.evaluation_cameras(place))}


def _write_images(folder: Path, place: synthetic.Config, cameras: Mapping[str, synthetic.Camera], first: int) -> None:
    """Photographs by name, rendered side by side; `first` is the number of the first one's noise."""

    def render_png(camera: synthetic.Camera, number: int) -> bytes:
        return encode_png(synthetic.render_image(place, camera, noise_seed=number))

    synthetic.solids(place)  # or each thread would make it
    files = map_parallel(render_png, cameras.values(), range(first, first + len(cameras)))
    write_files(folder, {f"images/{name}": file for name, file in zip(cameras, files, strict=True)})


def compute_max_capture_bytes(place: synthetic.Config) -> int:
    """Bytes that `write_capture` stays below: those of its photographs without compression."""
    return (2 * place.views - 1) * place.width * place.height * 3
