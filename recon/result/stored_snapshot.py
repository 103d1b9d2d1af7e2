"""A result on disk as the snapshot that it was, and its photographs where they still are."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

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
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.library_lines import ignore_file_warnings
from splatnode.capture.process.system import outlast, raise_shortage
from splatnode.capture.process.terminal import notify
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, is_printable, sanitize_text
from splatnode.recon.result.export.limits import MAX_CAMERAS, SceneFileError, read_json_file
from splatnode.recon.result.export.stored import SOURCES, StoredResult, decode_cameras, read_cameras, read_gaussians
from splatnode.recon.result.placement import IDENTITY, Placement
from splatnode.recon.result.snapshot import (
    MAX_COORDINATE,
    CameraEstimate,
    GaussianArrays,
    KnownLenses,
    Landmarks,
    Snapshot,
    StoredDepthCheck,
    find_camera_problem,
)
from splatnode.recon.result.submap_index import JoinedMap, MapSet, SubmapEntry
from splatnode.recon.result.verdict import Code, Up, Verdict

# NumPy's archives of a result folder, read as what strangers may have made: bounded, and of plain arrays alone.


@contextlib.contextmanager
def open_npz(data: bytes, most_bytes: int, name: str, what: str) -> Iterator[Mapping[str, npt.NDArray[Any]]]:
    """The arrays of an archive, which together have at most so many bytes; each is read when it is asked for.

    Raises SceneFileError, also for an array that is asked for and not there; it calls the file `name`, and its content
    `what`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > most_bytes:
            raise SceneFileError(f"{name} holds {size} bytes; at most {most_bytes} are read")
        # Sides that no array has overflow when NumPy multiplies them, before it refuses them.
        with (
            ignore_file_warnings(),
            np.load(io.BytesIO(data), allow_pickle=False) as arrays,
            np.errstate(all="ignore"),
        ):
            yield arrays
    except (KeyError, ValueError, OSError, zipfile.BadZipFile, EOFError) as error:
        raise_shortage(error)
        raise SceneFileError(f"{name} is not a file of {what}, or is damaged: {error}") from error


# depth.npz: the file of a result folder that holds the depths that two photographs confirm.

DEPTHS = "depth.npz"  # in the result folder
MAX_DEPTH_BYTES = 1 << 29  # of the arrays in a file that is read
_LONGEST_SIDE = 8192  # pixels

Depths = Mapping[str, npt.NDArray[np.float16]]


def encode_depths(depths: Depths) -> bytes:
    """depth.npz: `names` (C,) of the cameras, and for each (h, w) z as `depth_0`, `depth_1` ...; NumPy arrays."""
    file = io.BytesIO()
    arrays: dict[str, Any] = {f"depth_{index}": each.astype(np.float16) for index, each in enumerate(depths.values())}
    np.savez_compressed(file, names=np.array([name.encode() for name in depths], np.bytes_), **arrays)
    return file.getvalue()


def read_depths(folder: Path) -> dict[str, npt.NDArray[np.float16]]:
    """The depths of the result in `folder`, by camera; none where it holds no such file.

    Raises SceneFileError where the file is damaged or is not ours, OSError.
    """
    path = folder / DEPTHS
    if not path.is_file():
        return {}
    with guard_untrusted(SceneFileError, str(path)):
        return decode_depths(read_bounded(path, MAX_DEPTH_BYTES, SceneFileError, str(path)), str(path))


def decode_depths(data: bytes, name: str = DEPTHS) -> dict[str, npt.NDArray[np.float16]]:
    """Reads depth.npz. Raises SceneFileError, which names the file as `name`, where it is something else."""
    with guard_untrusted(SceneFileError, name):
        with open_npz(data, MAX_DEPTH_BYTES, name, "depths") as arrays:
            names = arrays["names"]
            if names.ndim != 1 or names.dtype.kind != "S" or len(names) > MAX_CAMERAS:
                raise SceneFileError(f"{name}: names must be those of at most {MAX_CAMERAS} cameras")
            depths = [arrays[f"depth_{index}"] for index in range(len(names))]
        for depth in depths:
            sides = depth.shape if depth.ndim == 2 else (0,)
            if depth.dtype != np.float16 or not 1 <= min(sides) <= max(sides) <= _LONGEST_SIDE:
                raise SceneFileError(f"{name}: a depth must be (h, w) float16, got {depth.shape} {depth.dtype}")
            if not (np.isfinite(depth) & (depth >= 0)).all():
                raise SceneFileError(f"{name}: depths must be finite, and 0 or more")
        texts = [sanitize_text(each.decode(), LONGEST_NAME) for each in names.tolist()]
        return dict(zip(texts, depths, strict=True))


# Multi-view consistent depth: how much of a scene was measured by several views, in words of a verdict.
#
# Cameras can be right, and most of the scene a guess all the same: where only one view knows a depth, or none, the
# scene is like the photographs from their cameras, and like nothing in particular from elsewhere.

ADVICE = "Add photographs between these, a short step apart, so that each shows most of what the next one shows."


class ConsistentDepthConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Multi-view consistent depth: how much of a scene was measured by several views, in words of a verdict."""

    # Share of the pixels with multi-view consistent depth below which the verdict calls views away from the cameras
    # guesses. Of 22 sets of real photographs the ten below it reach 18.1 dB on held-out views, at most 21.7, and the
    # twelve above it 22.8 dB (tests/bench/results/consistent_depth.json). 0: never
    min_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.45


def format_percent(share: float) -> str:
    """A share in percent, rounded down: what is not measured is not claimed."""
    return f"{int(100 * share + 1e-9)} %"


def is_guess(share: float, config: ConsistentDepthConfig) -> bool:
    """Whether views away from the cameras show guesses, by the `share` of pixels with multi-view consistent depth."""
    return share < config.min_share


def append_consistent_depth(verdict: Verdict, share: float | None, config: ConsistentDepthConfig) -> Verdict:
    """The verdict with a sentence on the share of multi-view consistent depth, and advice where it is too small."""
    if share is None or not verdict.publishable:
        return verdict
    if not is_guess(share, config):
        return replace(
            verdict,
            message=f"{verdict.message} Other views confirm the depth of {format_percent(share)} of the pixels.",
        )
    sentence = f"Other views confirm the depth of only {format_percent(share)} of the pixels"
    return replace(
        verdict,
        message=f"{verdict.message} {sentence}: views away from the cameras are guesses.",
        advice=f"{verdict.advice} {ADVICE}".strip(),
    )


# landmarks.npz: the file of a result folder that holds its landmarks.

LANDMARKS = "landmarks.npz"  # in the result folder
DESCRIPTORS_A_PHOTOGRAPH = 2000  # kept at most, in the mean: 160 kB of the file
MOST_DESCRIPTORS = 60_000  # in all: 5 MB
MAX_LANDMARK_BYTES = 64 << 20  # of the arrays in a file that is read
_DESCRIPTOR_BYTES = 128
_MOST_BYTE, _MOST_NORM = 127, 181  # of a descriptor, so that products fit 16 bits: `quantise` makes no others
_ROWS, _COLUMNS = np.triu_indices(3)  # of a symmetric matrix, which is kept by half


def encode_landmarks(landmarks: Landmarks) -> bytes:
    """landmarks.npz: NumPy arrays, which `numpy.load(..., allow_pickle=False)` reads."""
    lenses, file = landmarks.lenses, io.BytesIO()
    arrays: dict[str, Any] = {
        "points": landmarks.points.astype(np.float32),
        "covariances": landmarks.covariances[:, _ROWS, _COLUMNS].astype(np.float32),
        "descriptors": landmarks.descriptors,
        "point_of": landmarks.point_of.astype(np.uint32),
        "photograph_of": landmarks.photograph_of.astype(np.uint16),
        "names": np.array([name.encode() for name in landmarks.names], np.bytes_),
        "Ts_world_camera": landmarks.Ts_world_camera,
        "lenses": np.column_stack([lenses.focals, lenses.radials, lenses.shifts, lenses.shapes]),
        "bounds": np.column_stack([landmarks.rotation_bounds, landmarks.centre_bounds]),
        "scale": np.array([landmarks.noise_px, landmarks.unit, float(landmarks.metric)]),
    }
    if landmarks.focal_bounds is not None:
        arrays[_FOCAL_BOUNDS] = landmarks.focal_bounds
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def read_landmarks(folder: Path) -> Landmarks:
    """The landmarks of the result in `folder`.

    Raises FileNotFoundError, which says what to do, where the folder holds none, SceneFileError where the file is
    damaged or is not ours, OSError.
    """
    path = folder / LANDMARKS
    if not path.is_file():
        raise FileNotFoundError(_explain_missing(folder))
    with guard_untrusted(SceneFileError, str(path)):
        return decode_landmarks(read_bounded(path, MAX_LANDMARK_BYTES, SceneFileError, str(path)), str(path))


def decode_landmarks(data: bytes, name: str = LANDMARKS) -> Landmarks:
    """Reads landmarks.npz. Raises SceneFileError, which names the file as `name`, where it is something else."""
    with guard_untrusted(SceneFileError, name):
        with open_npz(data, MAX_LANDMARK_BYTES, name, "landmarks") as arrays:
            found = {key: arrays[key] for key in _SHAPES if key != _FOCAL_BOUNDS or key in arrays}
        found["lenses"] = _insert_second_radial(found["lenses"])
        _check(found, name)
        return _make_landmarks(found)


_FOCAL_BOUNDS = "focal_bounds"  # that an earlier splatnode did not write
_SHAPES: dict[str, tuple[str, str, tuple[int, ...]]] = {  # kind, what its first axis counts, the other axes
    "points": ("f", "P", (3,)),
    "covariances": ("f", "P", (6,)),
    "descriptors": ("u", "D", (_DESCRIPTOR_BYTES,)),
    "point_of": ("u", "D", ()),
    "photograph_of": ("u", "D", ()),
    "names": ("S", "C", ()),
    "Ts_world_camera": ("f", "C", (4, 4)),
    "lenses": ("f", "C", (6,)),
    "bounds": ("f", "C", (2,)),
    "scale": ("f", "three", ()),
    _FOCAL_BOUNDS: ("f", "C", ()),
}


def _insert_second_radial(lenses: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(C, 6) of a file from before lenses had a second radial coefficient, which has (C, 5)."""
    return np.insert(lenses, 2, 0.0, axis=1) if lenses.ndim == 2 and lenses.shape[1] == 5 else lenses


def _check(found: dict[str, npt.NDArray[Any]], name: str) -> None:
    """Raises SceneFileError where shapes, types or numbers are not those of a file of ours."""
    counts: dict[str, int] = {"three": 3}
    for key, array in found.items():
        kind, count, rest = _SHAPES[key]
        known = counts.setdefault(count, len(array) if array.ndim else 0)
        if array.dtype.kind != kind or array.ndim != 1 + len(rest) or array.shape != (known, *rest):
            raise SceneFileError(f"{name}: {key} must be {('?', *rest)} of kind {kind!r}, got {array.shape}")
        if kind == "f" and not (np.abs(array.astype(np.float64)) <= MAX_COORDINATE).all():
            raise SceneFileError(f"{name}: {key} must be finite, within ±{MAX_COORDINATE:g}")
    if found["descriptors"].dtype != np.uint8 or counts["D"] > MOST_DESCRIPTORS or not counts["C"]:
        raise SceneFileError(f"{name}: there must be cameras, and at most {MOST_DESCRIPTORS} descriptors of bytes")
    lengths = np.linalg.norm(found["descriptors"].astype(np.float32), axis=1)
    if (found["descriptors"] > _MOST_BYTE).any() or (lengths > _MOST_NORM).any():
        raise SceneFileError(f"{name}: a descriptor has bytes of at most {_MOST_BYTE} and a norm up to {_MOST_NORM}")
    if (found["point_of"] >= counts["P"]).any() or (found["photograph_of"] >= counts["C"]).any():
        raise SceneFileError(f"{name}: descriptors must be of its points and photographs")
    for T_world_camera, lens in zip(found["Ts_world_camera"], found["lenses"], strict=True):
        problem = find_camera_problem(T_world_camera, np.diag([lens[0], lens[0], 1.0]), 1, 1)
        if problem:
            raise SceneFileError(f"{name}: {problem}")
    bounds = np.column_stack([found["bounds"], found.get(_FOCAL_BOUNDS, np.zeros(counts["C"]))])
    if (found["lenses"][:, [0, 5]] <= 0).any() or (found["scale"][:2] <= 0).any() or (bounds < 0).any():
        raise SceneFileError(f"{name}: focal lengths, shapes, bounds and units must be positive")


def _make_landmarks(found: dict[str, npt.NDArray[Any]]) -> Landmarks:
    covariances = np.empty((len(found["points"]), 3, 3))
    covariances[:, _ROWS, _COLUMNS] = found["covariances"]
    covariances[:, _COLUMNS, _ROWS] = found["covariances"]
    values, vectors = np.linalg.eigh(covariances)  # rounding, or a stranger, may have made one negative
    covariances = (vectors * values.clip(0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    lenses, bounds = found["lenses"], found["bounds"]
    noise_px, unit, metric = found["scale"].tolist()
    return Landmarks(
        found["points"].astype(np.float64),
        covariances,
        found["descriptors"],
        found["point_of"].astype(np.int64),
        found["photograph_of"].astype(np.int64),
        tuple(sanitize_text(name.decode(), LONGEST_NAME) for name in found["names"].tolist()),
        found["Ts_world_camera"],
        KnownLenses(lenses[:, 0], lenses[:, 1:3], lenses[:, 3:5], lenses[:, 5]),
        bounds[:, 0],
        bounds[:, 1],
        noise_px,
        unit,
        bool(metric),
        found.get(_FOCAL_BOUNDS),
    )


def _explain_missing(folder: Path) -> str:
    """Explains what to do where a folder has no landmarks."""
    if (folder / "scene.ply").is_file():
        return (
            f"{folder / LANDMARKS} is not there: an earlier splatnode made this result, or it is a merged map or a "
            "converted scene. Reconstruct the photographs again, or give the folder of one scene of the map"
        )
    if (folder / "report.json").is_file():
        return f"{folder} holds no scene: its report.json says why. A photograph can be placed in a scene only"
    return f"{folder} is not a result of splatnode; give the folder that splatnode replay --out wrote"


# A result on disk as the snapshot that it was, and its photographs where they still are.

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
        gains=report.gains,
        gain_sigmas=report.gain_sigmas,
        falloffs={name: -math.log1p(-loss) for name, loss in report.vignetting.items()},
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


_Gain = Annotated[float, msgspec.Meta(ge=1e-4, le=1e4)]
_Sigma = Annotated[float, msgspec.Meta(ge=0, le=1e3)]  # of the logarithm of a gain


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
    gains: dict[str, tuple[_Gain, _Gain, _Gain]] = {}
    gain_sigmas: dict[str, tuple[_Sigma, _Sigma, _Sigma]] = {}
    vignetting: dict[str, Annotated[float, msgspec.Meta(ge=0, lt=1)]] = {}

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
            *self.gains,
            *self.gain_sigmas,
            *self.vignetting,
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
    shown = {name: placement for name, placement in of.placements.items() if has_scene(whole.submaps[name])}
    folder = make_merged_path(out, of)
    if shown and (folder / make_piece_name(SHELL_PIECE)).is_file() and all(_is_merged(whole, n, folder) for n in shown):
        cameras = {each.name: each for each in decode_cameras(read_json_file(folder / "cameras.json"), str(folder))}
        used = {name: whole.submaps[name].frames_used for name in shown}
        known = {name: tuple(cameras[each] for each in names if each in cameras) for name, names in used.items()}
        pieces = [Piece(name, folder / make_piece_name(name), IDENTITY, known[name]) for name in shown]
        return Pieces((*pieces, Piece(SHELL_PIECE, folder / make_piece_name(SHELL_PIECE), IDENTITY, ())), merged=True)
    return Pieces(tuple(_make_scene_pieces(whole, shown)), merged=False)


def _is_merged(whole: MapSet, scene_id: str, folder: Path) -> bool:
    """Whether a merged result has the scene as it is now."""
    piece, scene = folder / make_piece_name(scene_id), whole.submaps[scene_id].folder
    return piece.is_file() and (scene is None or (scene / "scene.ply").stat().st_mtime <= piece.stat().st_mtime)


def has_scene(place: SubmapEntry) -> bool:
    """Whether the place has a result that may be shown."""
    return place.folder is not None and place.publishable and (place.folder / "scene.ply").is_file()


def _make_scene_pieces(whole: MapSet, placements: Mapping[str, Placement]) -> list[Piece]:
    found = []
    for scene_id, placement in placements.items():
        folder = whole.submaps[scene_id].folder
        assert folder is not None  # `has_scene` has seen to it
        cameras = tuple(placement.transform_camera(camera) for camera in read_cameras(folder / "cameras.json"))
        found.append(Piece(scene_id, folder / "scene.ply", placement, cameras))
    return found
