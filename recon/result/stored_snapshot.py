"""A result on disk as the snapshot that it was, and its photographs where they still are."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.image_file import (
    UnusableImage,
    ValueRange,
    decode_any_image,
    encode_jpeg,
    find_common_range,
    read_image_file,
)
from splatnode.capture.process.config import record_in
from splatnode.capture.process.system import outlast, raise_shortage
from splatnode.capture.process.terminal import notify
from splatnode.capture.process.text import guard_untrusted, is_printable, sanitize_text
from splatnode.recon.result.export.cameras import decode_cameras
from splatnode.recon.result.export.limits import SceneFileError, read_json_file
from splatnode.recon.result.export.stored import SOURCES, StoredResult, read_cameras, read_gaussians
from splatnode.recon.result.npz_files import LANDMARKS, read_landmarks
from splatnode.recon.result.placement import IDENTITY, Placement
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot, StoredDepthCheck
from splatnode.recon.result.submap_index import JoinedMap, MapSet, SubmapEntry
from splatnode.recon.result.verdict import Code, Up, Verdict

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
        depth_checks=tuple(each.restore() for each in report.depth),
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
            notify(log, f"it is not known which photographs the Gaussians come from: {sanitize_text(error)}")
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
    depth: Annotated[tuple[StoredDepthCheck, ...], msgspec.Meta(max_length=10_000)] = ()

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
            *(text for each in self.depth for text in (each.message, each.camera)),
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
        if not all(is_printable(text, _LONGEST_SENTENCE) for text in report.collect_texts()):
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


# The pieces of a map: what is read scene by scene, so that a part of a map can be looked at without the rest of it.
#
# Where the map was merged (`splatnode merge`), a piece is what the merged scene kept of a submap, beside the one of
# all far shells. Where it was not, or where scenes came since, a piece is the scene itself.

SHELL_PIECE = "far-shell"


@dataclass(frozen=True, eq=False)
class Piece:
    """A file with Gaussians, and how they lie in the map."""

    scene_id: str  # SHELL_PIECE: of no scene
    path: Path
    placement: Placement
    cameras: tuple[CameraEstimate, ...]  # of its scene, in the map's world

    def load_gaussians(self) -> GaussianArrays:
        """In the map's world and unit. Raises SceneFileError, which names the file, and OSError."""
        try:
            return self.placement.transform_gaussians(read_gaussians(self.path))
        except SceneFileError as error:
            raise SceneFileError(f"{self.path.parent}: {error}") from error


@dataclass(frozen=True, eq=False)
class Pieces:
    """All of a map."""

    pieces: tuple[Piece, ...]
    merged: bool  # whether they are what merging kept

    @property
    def cameras(self) -> tuple[CameraEstimate, ...]:
        """One camera for each image, in the order of the scenes."""
        found: dict[str, CameraEstimate] = {}
        for camera in (camera for piece in self.pieces for camera in piece.cameras):
            found.setdefault(camera.name, camera)
        return tuple(found.values())


def make_merged_path(out: Path, of: JoinedMap) -> Path:
    """Returns the path of a map's merged result."""
    return out / f"map-{of.name}"


def make_piece_name(scene_id: str) -> str:
    """The name, in a merged result, of the file with what was kept of a scene."""
    return f"pieces/{scene_id}.ply"


def find_pieces(whole: MapSet, of: JoinedMap, out: Path) -> Pieces:
    """The pieces of a map whose merged result may be in `out`. Raises SceneFileError, OSError."""
    shown = {name: placement for name, placement in of.placements.items() if has_scene(whole.places[name])}
    folder = make_merged_path(out, of)
    if shown and (folder / make_piece_name(SHELL_PIECE)).is_file() and all(_is_merged(whole, n, folder) for n in shown):
        cameras = {each.name: each for each in decode_cameras(read_json_file(folder / "cameras.json"), str(folder))}
        used = {name: whole.places[name].frames_used for name in shown}
        known = {name: tuple(cameras[each] for each in names if each in cameras) for name, names in used.items()}
        pieces = [Piece(name, folder / make_piece_name(name), IDENTITY, known[name]) for name in shown]
        return Pieces((*pieces, Piece(SHELL_PIECE, folder / make_piece_name(SHELL_PIECE), IDENTITY, ())), merged=True)
    return Pieces(tuple(_make_scene_pieces(whole, shown)), merged=False)


def _is_merged(whole: MapSet, scene_id: str, folder: Path) -> bool:
    """Whether a merged result has the scene as it is now."""
    piece, scene = folder / make_piece_name(scene_id), whole.places[scene_id].folder
    return piece.is_file() and (scene is None or (scene / "scene.ply").stat().st_mtime <= piece.stat().st_mtime)


def has_scene(place: SubmapEntry) -> bool:
    """Whether the place has a result that may be shown."""
    return place.folder is not None and place.publishable and (place.folder / "scene.ply").is_file()


def _make_scene_pieces(whole: MapSet, placements: Mapping[str, Placement]) -> list[Piece]:
    found = []
    for scene_id, placement in placements.items():
        folder = whole.places[scene_id].folder
        assert folder is not None  # `has_scene` has seen to it
        cameras = tuple(placement.transform_camera(camera) for camera in read_cameras(folder / "cameras.json"))
        found.append(Piece(scene_id, folder / "scene.ply", placement, cameras))
    return found
