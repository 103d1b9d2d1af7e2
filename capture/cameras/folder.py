"""A folder of photographs as a camera; one that `splatnode record` made gives back the frames that were seen."""

from __future__ import annotations

import bisect
import contextlib
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import image_file, recording
from splatnode.capture.depth_image import DepthImage, check_unit, describe_few_pairs, is_few, read_depth_file
from splatnode.capture.frame import (
    LARGEST_M,
    LONGEST_M,
    POSE_SIGMA_DEG,
    POSE_SIGMA_M,
    SIGMA_M,
    Baseline,
    DroppedFrame,
    Frame,
    FramesPerSecond,
    Intrinsics,
    Pace,
    RightImage,
    grey,
    make_frame,
    make_given_pose,
    pace_frames,
    partners,
    rename_frame,
)
from splatnode.capture.image_file import (
    MAX_PIXELS,
    SUFFIXES,
    DecodedImage,
    MaxPixels,
    UnusableImage,
    ValueRange,
    decode_any_image,
    find_common_range,
    read_image_file,
)
from splatnode.capture.image_header import image_kind, name_time
from splatnode.capture.lenses import same_aspect
from splatnode.capture.masks import Mask, apply_mask
from splatnode.capture.process.config import record_in
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.system import outlast, raise_shortage
from splatnode.capture.process.terminal import notify
from splatnode.capture.process.text import guard_untrusted, sanitize_name, sanitize_text

if TYPE_CHECKING:
    from splatnode.capture.pose_files import Trajectory


# Folders of photographs with depth images, in the layouts of TUM RGB-D, ScanNet and Record3D.

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
    notice: str = ""  # what people should know of the pairs; empty: nothing

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
    notice = _describe_pairs(len(found), offsets)
    return RgbdFolder("TUM RGB-D", places.pop(), found, 1.0 / _TUM_STEPS, notice=notice)


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
    paired, notice = _pair(folder / "color", _list_by_stem(folder / "depth"))
    return RgbdFolder("ScanNet", folder / "color", paired, None, lenses[0], lenses[1], notice=notice)


class _Metadata(msgspec.Struct, frozen=True):
    """The part of Record3D's metadata.json that is read."""

    K: Annotated[tuple[float, ...], msgspec.Meta(min_length=9, max_length=9)]  # column by column
    w: Annotated[int, msgspec.Meta(ge=1, le=65_535)]
    h: Annotated[int, msgspec.Meta(ge=1, le=65_535)]


def _open_record3d(folder: Path) -> RgbdFolder:
    """rgb/N.jpg, depth/N.exr in metres, smaller and aligned, and metadata.json with the lens of the photographs."""
    path = folder / "metadata.json"
    with guard_untrusted(RgbdFolderError, str(path)):
        metadata = record_in(read_bounded(path, _MAX_TEXT_BYTES, RgbdFolderError, str(path)), _Metadata)
    lens = _make_lens(np.array(metadata.K).reshape(3, 3).T, (metadata.w, metadata.h), str(path))
    depths = _list_by_stem(folder / "depth")
    if not depths:
        raise RgbdFolderError(
            f"{str(folder / 'depth')!r} has no depth images (.exr, .png, .npy): export from Record3D as EXR and RGB"
        )
    paired, notice = _pair(folder / "rgb", depths)
    return RgbdFolder("Record3D", folder / "rgb", paired, None, lens, noise="lidar", notice=notice)


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


DEFAULT_STEP_NS = 100_000_000  # between two loops of a single photograph, which has no rate
# Photographs that cannot be decoded here; they are reported as dropped.
_RAW = {
    ".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".orf", ".rw2", ".rwl", ".pef",
    ".srw", ".x3f", ".3fr", ".iiq", ".erf", ".kdc", ".dcr", ".mrw", ".gpr",
}  # fmt: skip
_OTHER_IMAGES = {
    ".jxl", ".gif", ".jxr", ".wdp", ".hdp", ".jpx", ".jpf", ".jpm", ".j2c", ".jls", ".tga", ".psd", ".xcf", ".exr",
    ".hdr", ".pic", ".pfm", ".pbm", ".pam", ".pxm", ".ras", ".sr", ".pcx", ".svg", ".heics", ".insp",
}  # fmt: skip
FOREIGN_SUFFIXES = _RAW | _OTHER_IMAGES
_MAX_OTHER_FILES = 1000  # of a folder, whose content is looked at for images that their names hide


class Right(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The photographs of the right half of a stereo camera, rectified; those of a pair have one name."""

    folder: Path  # with the right photographs
    baseline_m: Annotated[float, msgspec.Meta(gt=0, le=LONGEST_M)]  # between the two cameras, metres
    baseline_sigma_m: Annotated[float, msgspec.Meta(ge=0, le=LONGEST_M)] = SIGMA_M  # standard deviation, metres

    def __post_init__(self) -> None:
        self.baseline  # noqa: B018 (raises ValueError)

    @property
    def baseline(self) -> Baseline:
        return Baseline(self.baseline_m, self.baseline_sigma_m)


class Poses(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera's poses by odometry, a tracker or a drone's log, in metres; each photograph carries its own."""

    file: Path  # a TUM trajectory, nerfstudio's transforms.json, or the folder of a COLMAP model
    # Standard deviation of each position for which the file tells none, metres
    sigma_m: Annotated[float, msgspec.Meta(gt=0, le=LARGEST_M)] = POSE_SIGMA_M
    # And of each orientation about each axis, degrees
    sigma_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = POSE_SIGMA_DEG


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # The folder with the photographs, or a recording of `splatnode record`, or photographs with depth images in the
    # layout of TUM RGB-D, ScanNet or Record3D
    folder: Path
    names: tuple[str, ...] = ()  # the files to take, with or without suffix; none: all
    # The lens, of all images of its aspect ratio, instead of what their EXIF tells
    intrinsics: Intrinsics | None = None
    max_pixels: MaxPixels = MAX_PIXELS  # larger images are left out
    # By the stamps that the photographs get; those of a recording have their own
    fps: FramesPerSecond = 10.0
    pace: Pace = "fastest"  # recorded: at the pace of the stamps; fastest: as fast as they are taken
    loops: Annotated[int, msgspec.Meta(ge=1)] = 1  # how many times all are shown, each time under other names
    # Of a stereo camera, whose left photographs lie in `folder`: what the right one saw, by which lengths are in metres
    right: Right | None = None
    poses: Poses | None = None  # of the photographs; nothing: none are known


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """The photographs in natural order (img2 before img10); what cannot be used is named and left out.

    No other file of the folder is read: true cameras that lie there stay unknown.
    Raises FileNotFoundError or ValueError, with what to do, where there is nothing to stream.
    """
    if recording.is_recording(config.folder):
        if config.right is not None:
            raise ValueError(
                f"{str(config.folder)!r} is a recording, which has its right images in it: leave out right"
            )
        if config.poses is not None:
            raise ValueError(f"{str(config.folder)!r} is a recording, which has its poses in it: leave out poses")
        recorded = recording.read(config.folder)
        return pace_frames(
            _repeat_frames(lambda: recorded.frames(config.names, config.max_pixels), config.loops), config.pace
        )
    rgbd = find_rgbd_folder(config.folder)
    if rgbd is not None:
        if rgbd.notice:
            notify(log, rgbd.notice)
        lens = config.intrinsics or rgbd.intrinsics
        config = msgspec.structs.replace(config, folder=rgbd.photographs, intrinsics=lens)
    paths = select_images(config.folder, config.names)  # at once, before the first frame, so that mistakes show at once
    rights = {} if config.right is None else _partners(config.right.folder, paths)
    poses = None if config.poses is None else _load_poses(config.poses.file, paths)
    return pace_frames(_repeat_frames(lambda: _frames(paths, rights, poses, rgbd, config), config.loops), config.pace)


def _partners(folder: Path, lefts: list[Path]) -> dict[str, Path]:
    """The right photographs by the names of the left ones. Raises where no left one has a partner."""
    rights = {path.name: path for path in select_images(folder)}
    return {left: rights[right] for left, right in partners([path.name for path in lefts], list(rights)).items()}


def _load_poses(file: Path, paths: list[Path]) -> Trajectory:
    """Loads the poses. Raises ValueError where the file names photographs, and none of these; OSError."""
    from splatnode.capture.pose_files import read_poses  # brings what interpolates

    poses = read_poses(file)
    known = [*poses.by_camera, *poses.by_name]
    if known and not any(poses.names(frame_name(path)) for path in paths):
        raise ValueError(
            f"{str(file)!r} has poses of photographs such as {sanitize_text(min(known), 100)}, and none of "
            "those "
            f"here, such as {frame_name(paths[0])}; give the poses of these photographs"
        )
    return poses


def _repeat_frames(once: Callable[[], Iterator[Frame | DroppedFrame]], loops: int) -> Iterator[Frame | DroppedFrame]:
    """The frames `loops` times; stamps and ids go on, and names tell from the second time on which one it is."""
    first_id = first_ns = 0
    for loop in range(loops):
        last, step = None, DEFAULT_STEP_NS
        for item in once():
            prefix = f"loop{loop}_" if loop else ""
            if isinstance(item, Frame):
                step = item.stamp_ns - last.stamp_ns if last else step
                last = item
                yield rename_frame(item, first_id + item.frame_id, prefix + item.name, first_ns + item.stamp_ns)
            else:
                yield replace(item, name=prefix + item.name)
        if last is None:
            return
        first_id, first_ns = first_id + last.frame_id + 1, first_ns + last.stamp_ns + step


def _frames(
    paths: list[Path],
    rights: Mapping[str, Path],
    poses: Trajectory | None,
    rgbd: RgbdFolder | None,
    config: Config,
) -> Iterator[Frame | DroppedFrame]:
    frame_id, used = 0, find_common_range(paths, config.max_pixels)
    if used is not None:
        notify(log, describe_value_range(used))
    for path in paths:
        if (unreadable := explain_unreadable_file(path)) is not None:
            yield unreadable
            continue
        name = frame_name(path)
        try:
            data, decoded, right = outlast(lambda path=path: _read(path, rights, used, config), name)
        except UnusableImage as error:
            yield DroppedFrame(name, str(error))
        except OSError as error:
            yield DroppedFrame(name, f"cannot be read: {error.strerror}")
        else:
            image, intrinsics = decoded.image, decoded.intrinsics
            height, width = image.shape[:2]
            if config.intrinsics is not None and same_aspect(config.intrinsics, width, height):
                intrinsics = config.intrinsics.resized(width, height)
            stamp_ns = round(frame_id / config.fps * 1e9)
            # A file whose values are stretched is no file of this image: a recording would store it as it was.
            known = image, intrinsics, data if used is None else None, decoded.captured_at or name_time(name)
            item = make_frame(
                frame_id, name, stamp_ns, *known, right=right, exposure=decoded.exposure, camera=decoded.camera
            )
            item = apply_alpha_mask(item, decoded.mask)
            item = item if rgbd is None else rgbd.attach_depth(item, path.name)
            frame_id += isinstance(item, Frame)
            yield _attach_pose(item, poses, config.poses)
    if not config.names:
        yield from _hidden_images(config.folder)


def _read(
    path: Path, rights: Mapping[str, Path], used: ValueRange | None, config: Config
) -> tuple[bytes, DecodedImage, RightImage | None]:
    """The file's bytes, the photograph, and what the right camera saw. Raises UnusableImage, OSError."""
    data = read_image_file(path, config.max_pixels)
    return data, decode_any_image(data, config.max_pixels, used), _load_right_image(path, rights, config)


def describe_value_range(used: ValueRange) -> str:
    """Describes the value range of 16-bit images that is stretched to 8 bits."""
    return f"16-bit photographs use only {used}: this range is stretched to 8 bits, alike for all of them"


def apply_alpha_mask(item: Frame | DroppedFrame, mask: Mask | None) -> Frame | DroppedFrame:
    """Without what its alpha channel hides, which is no part of the photograph."""
    if isinstance(item, DroppedFrame) or mask is None:
        return item
    masked_item = apply_mask(item, mask)
    if isinstance(masked_item, DroppedFrame):
        return DroppedFrame(item.name, f"its alpha channel hides {100 * (1 - mask.mean()):.1f} % of it")
    return masked_item


def _hidden_images(folder: Path) -> Iterator[DroppedFrame]:
    """The files that are images by their content and not by their name, each left out."""
    known = SUFFIXES | FOREIGN_SUFFIXES
    listed = outlast(lambda: [*folder.iterdir()], frame_name(folder))
    visible = [path for path in listed if not path.name.startswith(".") and path.suffix.lower() not in known]
    for path in sorted(visible, key=natural_order)[:_MAX_OTHER_FILES]:
        with contextlib.suppress(OSError):  # what cannot be read is no image to anybody
            kind = outlast(lambda path=path: _image_kind(path), frame_name(path)) if path.is_file() else None
            if kind is not None:
                shown = f"{path.suffix} is no suffix of photographs" if path.suffix else "its name has no suffix"
                yield DroppedFrame(frame_name(path), f"{shown}, and its content is {kind}: give it that suffix")


def _image_kind(path: Path) -> str | None:
    with path.open("rb") as file:
        return image_kind(file.read(16))


def _attach_pose(item: Frame | DroppedFrame, poses: Trajectory | None, given: Poses | None) -> Frame | DroppedFrame:
    """Attaches the frame's pose, where it has one; drops the frame, with the reason, where that cannot be sent."""
    if isinstance(item, DroppedFrame) or poses is None or given is None:
        return item
    T_world_camera = poses.pose_of(item)
    if T_world_camera is None:
        return item
    try:
        sigmas = poses.sigmas_of(item) or (given.sigma_m, given.sigma_deg)
        return replace(item, given_pose=make_given_pose(T_world_camera, *sigmas))
    except ValueError as error:
        return DroppedFrame(item.name, f"its pose cannot be used: {error}")


def _load_right_image(path: Path, right_photographs: Mapping[str, Path], config: Config) -> RightImage | None:
    """Loads the right image of a photograph; None where it is not there. Raises as reading does."""
    partner = right_photographs.get(path.name)
    if partner is None or config.right is None:
        return None
    seen = decode_any_image(read_image_file(partner, config.max_pixels), config.max_pixels)[0]
    return RightImage(grey(seen), config.right.baseline)


def explain_unreadable_file(path: Path) -> DroppedFrame | None:
    """The photograph left out, where its format is one that cannot be read here; else None."""
    suffix = path.suffix.lower()
    remedy = _conversion_advice(suffix)
    return None if remedy is None else DroppedFrame(frame_name(path), f"{suffix} files cannot be read. {remedy}")


def _conversion_advice(suffix: str) -> str | None:
    """Says what to do with files of this suffix, where they cannot be read here; else None."""
    if suffix in image_file.HEIF_SUFFIXES:
        return image_file.advise_heif_installation()
    return "Convert it to JPEG or PNG" if suffix in FOREIGN_SUFFIXES else None


def frame_name(path: Path) -> str:
    """The file's name as text of one line: bytes that are no UTF-8, and control characters, are written as escapes.

    Names go into messages, JSON and lists of cameras, where a stray byte or a line break would end the reconstruction.
    So would two frames of one name: files whose names differ have names that differ.
    """
    return sanitize_name(path.name)


def name_photographs(paths: Sequence[Path]) -> list[str]:
    """The names of photographs by their files: of a recording, those that its frames have.

    A recording's right and depth images go with their frames, and have none. Raises ValueError for a file that is none
    of its recording's, and RecordingError.
    """
    recordings = {
        folder: recording.read(folder) for folder in {path.parent for path in paths} if recording.is_recording(folder)
    }
    names = ([frame_name(path)] if path.parent not in recordings else recordings[path.parent].name_files([path.name])
             for path in paths)  # fmt: skip
    return [name for found in names for name in found]


def image_paths(folder: Path) -> list[Path]:
    """The photographs that lie in `folder` itself, by their suffix, in natural order; hidden files are not for us.

    Nor are folders, pipes and devices, which could be waited for for ever. A link to nothing is, and what the disk or
    the network share does not tell of now: it will be named.
    """
    if not folder.is_dir():
        found = "is a file, not" if folder.exists() else "is not there; give"
        raise FileNotFoundError(f"{str(folder)!r} {found} a folder that holds JPEG or PNG photographs")
    suffixes = SUFFIXES | FOREIGN_SUFFIXES
    visible = [path for path in folder.iterdir() if not path.name.startswith(".")]
    chosen = [path for path in visible if path.suffix.lower() in suffixes and _may_be_file(path)]
    return sorted(chosen, key=natural_order)


def _may_be_file(path: Path) -> bool:
    try:
        return path.is_file() or not path.exists()
    except PermissionError:  # the folder itself may not be entered
        raise
    except OSError:
        return True


def names_in(folder: Path) -> list[str]:
    """Lists the names that `Config.names` can choose from, in order. Raises as `stream` does."""
    if recording.is_recording(folder):
        return recording.read(folder).names
    return [frame_name(path) for path in select_images(find_photographs(folder))]


def select_images(folder: Path, names: tuple[str, ...] = ()) -> list[Path]:
    """The photographs of `folder` called `names`, or all. Raises where one is missing.

    A photograph is called by its file's name, with or without suffix, and by the name of its frame.
    """
    paths = image_paths(folder)
    if not paths:
        inside = sorted(frame_name(child) for child in folder.iterdir() if child.is_dir() and image_paths(child))
        hidden = [f"{each.name}: {each.reason}" for each in _hidden_images(folder)]
        advice = f"give one of its folders: {', '.join(inside)}" if inside else "give a folder of JPEGs or PNGs"
        advice += ", or all of them as the cameras of one robot with --cameras all" if len(inside) > 1 else ""
        advice = f"{hidden[0]}{f', and {len(hidden) - 1} more' if len(hidden) > 1 else ''}" if hidden else advice
        raise ValueError(f"no photographs in {str(folder)!r}; {advice}")
    suffixes = sorted({path.suffix.lower() for path in paths})
    remedies = [_conversion_advice(suffix) for suffix in suffixes]
    if remedies[0] is not None and None not in remedies:
        raise ValueError(f"{str(folder)!r} holds only {', '.join(suffixes)} files. {remedies[0]}")
    called = {path: {path.name, path.stem, frame_name(path)} for path in paths}
    missing = [sanitize_text(name) for name in names if not any(name in own for own in called.values())]
    if missing:
        present = ", ".join(frame_name(path) for path in paths[:5]) + (", ..." if len(paths) > 5 else "")
        raise ValueError(f"no photograph named {', '.join(missing)} in {str(folder)!r}; it holds {present}")
    return [path for path in paths if not names or not called[path].isdisjoint(names)]


def natural_order(path: Path) -> tuple:
    """Sort key by which numbers count as numbers: img2 before img10. Ties (img2, img02) fall back to the name."""
    parts = re.split(r"([0-9]+)", path.name.lower())
    return tuple((int(part), "") if part.isdecimal() else (-1, part) for part in parts if part), path.name
