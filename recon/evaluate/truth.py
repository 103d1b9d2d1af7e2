"""Scenes with known cameras, as they lie on disk. What is read here must never reach a reconstruction."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras.folder import frame_name
from splatnode.capture.frame import Frame
from splatnode.capture.image_file import SUFFIXES
from splatnode.recon.result.export import read_cameras

_CHOSEN = "24_views"  # of InstantSplat's data sets: the frames that its protocol uses
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class TrueCamera:
    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3) for an image `width` x `height`
    width: int
    height: int

    def K_for(self, width: int, height: int) -> npt.NDArray[np.float64]:
        """K of the image resized to `width` x `height`."""
        return self.K * np.array([width / self.width, height / self.height, 1.0])[:, None]


@dataclass(frozen=True, eq=False)
class EvaluationScene:
    """Images by name in their order, and the true cameras of those that have one."""

    name: str
    paths: Mapping[str, Path]
    cameras: Mapping[str, TrueCamera]

    def image(self, name: str) -> npt.NDArray[np.uint8]:
        """(H, W, 3) RGB. Raises ValueError where the file is not an image."""
        pixels = cv2.imread(str(self.paths[name]), cv2.IMREAD_COLOR)
        if pixels is None:
            raise ValueError(f"{self.paths[name]} must be an image, it cannot be decoded")
        return np.ascontiguousarray(pixels[..., ::-1]).astype(np.uint8)

    def frames(self, names: Sequence[str]) -> list[Frame]:
        """What a reconstruction gets: images in the given order, and nothing known about the camera."""
        return [Frame(i, name, i, self.image(name), None) for i, name in enumerate(names)]


def load_scene(folder: Path) -> EvaluationScene:
    """The scene in `folder`: images/ and one of cameras.json, transforms.json or sparse/0, in this order.

    cameras.json is ours ("cameras": T_world_camera) or that of recorded data sets ("images": R, t); transforms.json is
    nerfstudio's; sparse/0 is a COLMAP model, text or binary. Tanks and Temples and MVImgNet as InstantSplat gives them
    have all that in a folder 24_views of the scene's, which is found from either. Images must be undistorted. Raises
    FileNotFoundError where a part is missing, ValueError where it cannot be what it should be.
    """
    place = scene_folder(folder)
    data = place / _CHOSEN if (place / _CHOSEN).is_dir() else place
    paths = {frame_name(path): path for path in sorted((data / "images").glob("*")) if path.suffix.lower() in SUFFIXES}
    if not paths:
        raise FileNotFoundError(f"{data / 'images'} must hold the scene's images; there are none")
    readers = {"cameras.json": _cameras_json, "transforms.json": _transforms_json, "sparse/0": _colmap}
    for source, read in readers.items():
        if (data / source).exists():
            cameras = read(data / source)
            return EvaluationScene(
                place.name, paths, {name: cameras[path.name] for name, path in paths.items() if path.name in cameras}
            )
    raise FileNotFoundError(f"{data} must hold the true cameras as one of {', '.join(readers)}; there is none")


def scene_folder(folder: Path) -> Path:
    """The folder with the scene's name, where `folder` may be the one of its chosen frames."""
    return folder.parent if folder.name == _CHOSEN else folder


def _cameras_json(path: Path) -> dict[str, TrueCamera]:
    content = json.loads(path.read_text())
    if "cameras" in content:
        return {c.name: TrueCamera(c.T_world_camera, c.K, c.width, c.height) for c in read_cameras(path)}
    if "images" not in content:
        raise ValueError(f"{path} must have a list 'cameras' or 'images', has {sorted(content)}")
    cameras = {}
    for entry in content["images"]:
        if "R" in entry:  # some data sets have images whose camera nobody knows
            T_camera_world = np.eye(4)
            T_camera_world[:3, :3], T_camera_world[:3, 3] = entry["R"], entry["t"]
            cameras[entry["name"]] = TrueCamera(
                _inverse(T_camera_world), np.array(entry["K"], np.float64), entry["width"], entry["height"]
            )
    return cameras


def _transforms_json(path: Path) -> dict[str, TrueCamera]:
    content = json.loads(path.read_text())
    cameras = {}
    for frame in content["frames"]:
        values = {**content, **frame}
        missing = [key for key in ("w", "h", "fl_x", "transform_matrix") if key not in values]
        if missing:
            raise ValueError(f"{path} must give {', '.join(missing)} for {frame['file_path']}")
        distortion = {key: values[key] for key in ("k1", "k2", "k3", "k4", "p1", "p2") if values.get(key)}
        if distortion:
            raise ValueError(f"{path} must be of undistorted images, {frame['file_path']} has {distortion}")
        width, height, fx = int(values["w"]), int(values["h"]), values["fl_x"]
        cx, cy = values.get("cx", width / 2), values.get("cy", height / 2)
        K = np.array([[fx, 0.0, cx], [0.0, values.get("fl_y", fx), cy], [0.0, 0.0, 1.0]])
        T_world_camera = np.array(frame["transform_matrix"], np.float64) @ _OPENGL
        cameras[Path(frame["file_path"]).name] = TrueCamera(T_world_camera, K, width, height)
    return cameras


def _colmap(path: Path) -> dict[str, TrueCamera]:
    import pycolmap

    model = pycolmap.Reconstruction(path)
    cameras = {}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        if camera.model.name not in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise ValueError(f"{path} must be of undistorted images (PINHOLE), {image.name} is {camera.model.name}")
        T_camera_world = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        cameras[Path(image.name).name] = TrueCamera(
            _inverse(T_camera_world), camera.calibration_matrix(), camera.width, camera.height
        )
    return cameras


def _inverse(T: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.linalg.inv(T).astype(np.float64)
