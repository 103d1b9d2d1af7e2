"""Folders of photographs with depth images, in the layouts of TUM RGB-D, ScanNet and Record3D."""

from __future__ import annotations

import bisect
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_files import describe_few_pairs, is_few, read_depth_file
from splatnode.capture.depth_image import DepthImage, check_unit
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.image_file import UnusableImage
from splatnode.capture.process.config import record_in
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.system import outlast, raise_shortage
from splatnode.capture.process.terminal import notify
from splatnode.capture.process.text import guard_untrusted, sanitize_name, sanitize_text

log = logging.getLogger(__name__)

_MAX_TEXT_BYTES = 50_000_000
_MOST_LINES, _MOST_S = 500_000, 1e11  # of a list of files, and of a time in it
_TUM_STEPS = 5000.0  # of depth a metre
_TUM_APART_S = 0.02  # between a photograph and its depth image, as TUM's associate.py has it
_PHOTOGRAPH_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
_DEPTH_SUFFIXES = (".png", ".exr", ".npy", ".tif", ".tiff")


class RgbdFolderError(ValueError):
    """A folder in one of the layouts that cannot be read; the message names the file."""


@dataclass(frozen=True, eq=False)
class RgbdFolder:
    """The files of photographs and of their depth images."""

    layout: str  # TUM RGB-D, ScanNet or Record3D
    photographs: Path  # the folder with the photographs
    depth_of: Mapping[str, Path] = field(repr=False)  # by the name of the photograph's file
    unit_m: float | None = None  # of a step; None: millimetres of whole numbers, metres of floats
    intrinsics: Intrinsics | None = None  # of the photographs, for their size
    depth_intrinsics: Intrinsics | None = None  # of the depth camera; None: depth is aligned with the photographs
    noise: str = "structured_light"  # the kind of the depth camera
    told: str = ""  # what people should know of the pairs; empty: nothing

    def attach_depth(self, item: Frame | DroppedFrame, file: str) -> Frame | DroppedFrame:
        """The photograph of `file` with its depth image; without, which the log tells, where that cannot be used."""
        path = self.depth_of.get(file)
        if isinstance(item, DroppedFrame) or path is None:
            return item
        try:
            return replace(item, depth=outlast(lambda: self._read(path), item.name))
        except (UnusableImage, ValueError) as error:
            notify(log, f"{item.name}: its depth image is left out: {sanitize_text(error)}")
        except OSError as error:
            notify(log, f"{item.name}: its depth image cannot be read: {error.strerror}")
        return item

    def _read(self, path: Path) -> DepthImage:
        made = read_depth_file(path, self.unit_m, self.depth_intrinsics, self.noise)
        check_unit(made)  # the layout tells the unit, and the file may have another one
        return made


def find_rgbd_folder(folder: Path) -> RgbdFolder | None:
    """The files in `folder`, if it is in one of the layouts; None of another one. Raises RgbdFolderError, OSError."""
    if not folder.is_dir():
        return None
    if (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file():
        return _open_tum(folder)
    if (folder / "color").is_dir() and (folder / "depth").is_dir() and (folder / "intrinsic").is_dir():
        return _open_scannet(folder)
    if (folder / "rgb").is_dir() and (folder / "depth").is_dir() and (folder / "metadata.json").is_file():
        return _open_record3d(folder)
    return None


def find_photographs(folder: Path) -> Path:
    """The folder in which photographs lie: that of the layout, else itself. Raises as `find_rgbd_folder`."""
    found = find_rgbd_folder(folder)
    return folder if found is None else found.photographs


def _open_tum(folder: Path) -> RgbdFolder:
    """rgb.txt and depth.txt list a time and a file each; a photograph gets the depth image that is nearest in time."""
    colours, depths = _read_list(folder / "rgb.txt"), _read_list(folder / "depth.txt")
    places = {(folder / file).parent for _, file in colours}
    if len(places) != 1:
        raise RgbdFolderError(f"{str(folder / 'rgb.txt')!r} must list files of one folder, got {len(places)} folders")
    depths.sort()
    times, found, offsets = [time for time, _ in depths], {}, []
    for time, file in colours:
        at = bisect.bisect_left(times, time)
        near = min(depths[max(0, at - 1) : at + 1], key=lambda each: abs(each[0] - time))
        offsets.append(near[0] - time)
        if abs(near[0] - time) <= _TUM_APART_S:
            found[Path(file).name] = folder / near[1]
    told = _describe_pairs(len(found), offsets)
    return RgbdFolder("TUM RGB-D", places.pop(), found, 1.0 / _TUM_STEPS, told=told)


def _describe_pairs(num_found: int, offsets: Sequence[float]) -> str:
    """How many photographs got a depth image, where fewer than most did; `offsets` (s) are to the nearest of each."""
    if not is_few(num_found, len(offsets)):
        return ""
    median_s = float(np.median(offsets))
    by = f"{1000 * median_s:+.0f} ms" if abs(median_s) < 10 else f"{median_s:+.3g} s"
    return (
        f"{num_found} of {len(offsets)} photographs have a depth image within {1000 * _TUM_APART_S:.0f} ms of "
        f"their time (rgb.txt, depth.txt); the nearest is {by} away in the median. Where the clocks differ by so much, "
        "add it to the times of one file; where depth comes less often, this is right"
    )


def _read_list(path: Path) -> list[tuple[float, str]]:
    """The times and files of a list, in order. Raises RgbdFolderError where a file lies elsewhere."""
    content = read_bounded(path, _MAX_TEXT_BYTES, RgbdFolderError, str(path))
    found = []
    for number, line in enumerate(content.decode("utf-8", "replace").splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{str(path)!r}, line {number}"
        time, _, file = line.strip().partition(" ")
        try:
            seconds = float(time)
        except ValueError:
            seconds = float("nan")
        if not abs(seconds) < _MOST_S or not file.strip():
            raise RgbdFolderError(f"{where} must be a time and a file, got {sanitize_text(line, 60)!r}")
        parts = Path(file.strip()).parts
        if not parts or Path(file.strip()).is_absolute() or ".." in parts or "\0" in file:
            raise RgbdFolderError(f"{where} must name a file in this folder, got {sanitize_text(file, 60)!r}")
        found.append((seconds, file.strip()))
        if len(found) > _MOST_LINES:
            raise RgbdFolderError(f"{str(path)!r} must list at most {_MOST_LINES} files; cut the recording")
    if not found:
        raise RgbdFolderError(f"{str(path)!r} lists no files")
    return found


def _open_scannet(folder: Path) -> RgbdFolder:
    """color/N.jpg, depth/N.png in millimetres, and the lenses of both as matrices."""
    lenses = []
    for name in ("color", "depth"):
        path, first = folder / "intrinsic" / f"intrinsic_{name}.txt", _first_size(folder / name)
        lenses.append(_make_lens(_read_matrix(path), first, str(path)) if path.is_file() and first else None)
    paired, told = _pair(folder / "color", _list_by_stem(folder / "depth"))
    return RgbdFolder("ScanNet", folder / "color", paired, None, lenses[0], lenses[1], told=told)


class _Metadata(msgspec.Struct, frozen=True):
    """The part of Record3D's metadata.json that is read."""

    K: Annotated[tuple[float, ...], msgspec.Meta(min_length=9, max_length=9)]  # column by column
    w: Annotated[int, msgspec.Meta(ge=1, le=65_535)]
    h: Annotated[int, msgspec.Meta(ge=1, le=65_535)]


def _open_record3d(folder: Path) -> RgbdFolder:
    """rgb/N.jpg, depth/N.exr in metres, smaller and aligned, and metadata.json with the lens of the photographs."""
    path = folder / "metadata.json"
    with guard_untrusted(RgbdFolderError, str(path)):
        told = record_in(read_bounded(path, _MAX_TEXT_BYTES, RgbdFolderError, str(path)), _Metadata)
    lens = _make_lens(np.array(told.K).reshape(3, 3).T, (told.w, told.h), str(path))
    depths = _list_by_stem(folder / "depth")
    if not depths:
        raise RgbdFolderError(
            f"{str(folder / 'depth')!r} has no depth images (.exr, .png, .npy): export from Record3D as EXR and RGB"
        )
    paired, told = _pair(folder / "rgb", depths)
    return RgbdFolder("Record3D", folder / "rgb", paired, None, lens, noise="lidar", told=told)


def _list_by_stem(folder: Path) -> dict[str, Path]:
    files = (path for path in folder.iterdir() if path.suffix.lower() in _DEPTH_SUFFIXES)
    return {path.stem: path for path in sorted(files)}


def _pair(photographs: Path, depths: Mapping[str, Path]) -> tuple[dict[str, Path], str]:
    """The depth images of photographs that have the same name, and what people should know of the pairs."""
    files = [path for path in photographs.iterdir() if path.suffix.lower() in _PHOTOGRAPH_SUFFIXES]
    found = {path.name: depths[path.stem] for path in files if path.stem in depths}
    return found, describe_few_pairs(len(found), len(files))


def _first_size(folder: Path) -> tuple[int, int] | None:
    """Width and height of an image of the folder that tells it."""
    from splatnode.capture.image_file import read_image_file, upright_size

    for path in sorted(folder.iterdir()):
        try:
            if path.is_file() and (size := upright_size(read_image_file(path))) is not None:
                return size
        except (UnusableImage, OSError) as error:
            raise_shortage(error)
    return None


def _read_matrix(path: Path) -> npt.NDArray[np.float64]:
    content = read_bounded(path, 10_000, RgbdFolderError, str(path)).decode("utf-8", "replace")
    try:
        matrix = np.array([[float(number) for number in line.split()] for line in content.splitlines() if line.strip()])
    except ValueError:
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 3), (4, 4), (3, 4)):
        raise RgbdFolderError(f"{str(path)!r} must be a matrix of 3 or 4 rows and columns, got {matrix.shape}")
    return matrix[:3, :3]


def _make_lens(K: npt.NDArray[np.float64], size: tuple[int, int], where: str) -> Intrinsics:
    """A pinhole of K, whose principal point counts from the centre of the top-left pixel."""
    width, height = size
    try:
        fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        return Intrinsics(width, height, fx, fy, cx + 0.5, cy + 0.5, "calibration")
    except ValueError as error:
        raise RgbdFolderError(f"{sanitize_name(where)}: {error}") from error
