"""A result on disk as the snapshot that it was, and its photographs where they still are."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.image_file import (
    UnusableImage,
    decode_any_image,
    encode_jpeg,
    find_common_range,
    read_image_file,
)
from splatnode.capture.process.foreign import guard_untrusted
from splatnode.capture.process.memory_shortage import outlast, raise_shortage
from splatnode.capture.process.printable import is_printable
from splatnode.capture.process.records import record_in
from splatnode.capture.value_range import ValueRange
from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.sources import SOURCES
from splatnode.recon.result.export.stored import StoredResult, read_cameras, read_gaussians
from splatnode.recon.result.landmarks_file import LANDMARKS, read_landmarks
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.up import Up
from splatnode.recon.result.verdict import Code, Verdict

log = logging.getLogger(__name__)

_LONGEST_SENTENCE = 10_000  # characters, of a report
_PHOTOGRAPH_SIDE = 640  # pixels: a blend with the render in a window needs no more
_JPEG_QUALITY = 90


def read_result(place: Path) -> tuple[Snapshot, list[Path]]:
    """The snapshot in a result's folder or a scene file, and the folders in which its photographs may be.

    These are where the report says that they were, where a result of `splatnode demo` has them, and beside the scene.
    A folder without a scene must have a report that says why. Raises SceneFileError, FileNotFoundError, ValueError.
    """
    folder = place if place.is_dir() else place.parent
    scene = place / "scene.ply" if place.is_dir() else place
    report = _read_report(folder / "report.json") if place.is_dir() else None
    if not scene.is_file() and report is None:
        raise FileNotFoundError(
            f"{scene} is not there. Give a result's folder (splatnode replay FOLDER --out DIR), a .ply, .spz or .splat "
            "file, or the node's configuration (.yaml)"
        )
    report = report or _Report(Verdict(Code.OK, "A scene from a file, without a report.", "", publishable=True))
    gaussians = _read_gaussians(scene) if scene.is_file() else GaussianArrays.empty()
    cameras = read_cameras(folder / "cameras.json") if (folder / "cameras.json").is_file() else ()
    snapshot = Snapshot(
        sequence=0,
        verdict=report.verdict,
        cameras=cameras,
        gaussians=gaussians,
        images={},
        dropped=report.frames_dropped,
        iterations=report.iterations,
        seconds=report.seconds,
        final=not report.verdict.provisional,
        scale=StoredResult(scene).scale(),
        up=report.up,
        scenes=tuple(each.scene for each in report.scenes),
    )
    return snapshot, _list_folders(folder, report)


def list_image_folders(folder: Path) -> list[Path]:
    """Lists folders that may hold the images of the result in `folder`. Raises SceneFileError, OSError."""
    return _list_folders(folder, _read_report(folder / "report.json"))


def _list_folders(folder: Path, report: _Report | None) -> list[Path]:
    reported = [] if report is None or report.photographs is None else [Path(report.photographs)]
    return [*reported, folder / "images", folder / "capture" / "images"]


def _read_gaussians(scene: Path) -> GaussianArrays:
    """Reads the Gaussians, with their source frames if known. Raises SceneFileError, OSError."""
    sources = scene.with_name(SOURCES)
    if scene.suffix.lower() == ".ply" and sources.is_file():
        try:
            return read_gaussians(scene, sources)
        except SceneFileError as error:
            raise_shortage(error)
            log.warning("it is not known which photographs the Gaussians come from: %s", error)
    return read_gaussians(scene)


class _Scene(msgspec.Struct, frozen=True):
    """One of the scenes that were merged."""

    scene: str


class _Report(msgspec.Struct, frozen=True):
    """The part of report.json that is shown."""

    verdict: Verdict
    frames_dropped: tuple[DroppedFrame, ...] = ()
    iterations: Annotated[int, msgspec.Meta(ge=0, lt=1 << 31)] = 0
    seconds: dict[str, Annotated[float, msgspec.Meta(ge=0, le=1e9)]] = {}
    photographs: str | None = None
    up: Up | None = None
    scenes: tuple[_Scene, ...] = ()

    def collect_texts(self) -> list[str]:
        """All that it says, which is shown; where its photographs lie is not."""
        verdict = self.verdict
        dropped = [text for frame in self.frames_dropped for text in (frame.name, frame.reason)]
        return [
            verdict.message,
            verdict.advice,
            *verdict.frames,
            *dropped,
            *self.seconds,
            *(each.scene for each in self.scenes),
            self.up.source if self.up else "",
        ]


def read_up(folder: Path) -> Up | None:
    """Reads the up direction from the report in `folder`, if it has one. Raises SceneFileError, OSError."""
    report = _read_report(folder / "report.json")
    return None if report is None else report.up


def _read_report(path: Path) -> _Report | None:
    """None where there is none. Raises SceneFileError where it is something else, OSError."""
    if not path.is_file():
        return None
    with guard_untrusted(SceneFileError, str(path)):
        try:
            report = record_in(read_json_file(path), _Report)
        except msgspec.MsgspecError as error:
            raise SceneFileError(f"{path} is not a report of splatnode, or is damaged: {error}") from error
        if not all(is_printable(text, _LONGEST_SENTENCE) for text in report.texts()):
            longest = f"at most {_LONGEST_SENTENCE} characters"
            raise SceneFileError(f"{path} is not a report of splatnode: its texts must be printable, of {longest}")
        return report


def load_images(cameras: tuple[CameraEstimate, ...], folders: Sequence[Path]) -> dict[str, npt.NDArray[np.uint8]]:
    """Loads each camera's image from the first of `folders` that has it, reduced to a window's size."""
    found = {}
    used = find_common_range([folder / camera.name for camera in cameras for folder in folders])
    for camera in cameras:
        try:
            path = find_image(camera, folders)
            if path is not None:
                found[camera.name] = outlast(lambda path=path: _photograph(path, used), camera.name)
        except (UnusableImage, OSError) as error:
            log.warning("%s is shown without its photograph: %s", camera.name, error)
    return found


def _photograph(path: Path, used: ValueRange | None) -> npt.NDArray[np.uint8]:
    return _shrink(decode_any_image(read_image_file(path), used=used).image)


def find_image(camera: CameraEstimate, folders: Sequence[Path]) -> Path | None:
    """Finds the camera's image in the first of the `folders` that has one. Raises OSError."""
    paths = (folder / camera.name for folder in folders)
    return next((path for path in paths if path.is_file()), None)


def _shrink(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    scale = min(1.0, _PHOTOGRAPH_SIDE / max(image.shape[:2]))
    size = math.ceil(image.shape[1] * scale), math.ceil(image.shape[0] * scale)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def load_full_snapshot(result: StoredResult) -> Snapshot:
    """All that a recording of a result tells: selected Gaussians, cameras, photographs, landmarks and the verdict.

    Photographs that are not found are left out. Raises what reading the files raises.
    """
    gaussians = result.gaussians()
    folder = result.scene.parent
    whole = (folder / "report.json").is_file() and result.scene.name == "scene.ply"
    snapshot, folders = read_result(folder if whole else result.scene)
    images = load_images(snapshot.cameras, folders)
    landmarks = read_landmarks(folder) if whole and (folder / LANDMARKS).is_file() else None
    return replace(snapshot, gaussians=gaussians, images=images, landmarks=landmarks)


def encode_image(camera: CameraEstimate, images: Mapping[str, npt.NDArray[np.uint8]]) -> bytes | None:
    """The camera's photograph as a JPEG file of `camera.width` x `camera.height`; None where there is none."""
    image = images.get(camera.name)
    if image is None:
        return None
    sized = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return encode_jpeg(np.asarray(sized, np.uint8), _JPEG_QUALITY)
