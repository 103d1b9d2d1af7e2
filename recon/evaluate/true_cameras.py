"""True cameras from the files in which data sets have them: cameras.json, transforms.json, COLMAP's models."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.capture.process.foreign import guard_untrusted
from splatnode.capture.process.printable import LONGEST_TEXT, sanitize_text
from splatnode.recon.evaluate.colmap_model import read_model
from splatnode.recon.evaluate.json_file import EvaluationFileError, read_json
from splatnode.recon.result.camera_check import find_camera_problem
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.export.cameras import Number, Row3, Row4
from splatnode.recon.result.export.quaternions import matrices_from_quats

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
        told = {key: getattr(view, key) for key in _Lens.__struct_fields__}
        values = {key: getattr(content, key) if value is None else value for key, value in told.items()}
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
