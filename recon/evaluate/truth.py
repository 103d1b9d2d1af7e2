"""Scenes with known cameras, as they lie on disk. What is read here must never reach a reconstruction."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras.folder import frame_name, image_paths
from splatnode.capture.frame import Frame
from splatnode.capture.image_file import SUFFIXES, UnusableImage, decode_any_image, read_image_file, upright_size
from splatnode.capture.masks import mask_frames, open_masks
from splatnode.capture.process.printable import sanitize_text
from splatnode.recon.evaluate.json_file import EvaluationFileError
from splatnode.recon.evaluate.true_cameras import TrueCamera, read_true_cameras

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
