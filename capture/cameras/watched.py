"""A folder into which photographs are put while it is watched: by a copy, a network share, another program."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.cameras.folder import apply_alpha_mask, explain_unreadable_file, frame_name, image_paths
from splatnode.capture.frame import (
    CameraUnavailable,
    Clock,
    DroppedFrame,
    ExposureSettings,
    Frame,
    GivenPose,
    Gravity,
    Intrinsics,
    KeepAlive,
    Motion,
    MountNumbers,
    Stamp,
    make_frame,
    nearest_stamp,
)
from splatnode.capture.image_file import (
    MAX_PIXELS,
    DecodedImage,
    MaxPixels,
    UnusableImage,
    ValueRange,
    check_whole,
    decode_any_image,
    find_range,
    measure_values,
    read_image_file,
)
from splatnode.capture.image_header import name_time
from splatnode.capture.lenses import assign_lens, check_fits, same_aspect
from splatnode.capture.process.config import Internal, record_in
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.system import is_shortage, outlast
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_text

REMEMBERED = 100_000  # photographs that were taken and are no longer there: all may be back
_TEMPORARY_SUFFIXES = {".tmp", ".part", ".partial", ".crdownload", ".filepart"}


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    folder: Path  # the folder that is watched
    include_existing: bool = True  # whether what lies there at the start is taken, too
    poll_s: Internal[Annotated[float, msgspec.Meta(gt=0)]] = 0.2  # between looks at the folder
    stable_s: Annotated[float, msgspec.Meta(ge=0)] = 0.4  # a file is whole when it has not changed for so long
    # A file that is not whole, or cannot be read, after so long is left out
    file_timeout_s: Internal[Annotated[float, msgspec.Meta(gt=0)]] = 60.0
    max_pixels: MaxPixels = MAX_PIXELS  # larger images are left out
    # The lens, of all images of its aspect ratio, instead of what their EXIF tells
    intrinsics: Intrinsics | None = None
    # Whether each image has a file beside it, image.json for image.jpg, that tells its pose, lens, time and more. The
    # image waits for that file
    sidecars: bool = False
    camera_id: str = ""  # of several cameras, which one took the images; a sidecar file may tell another


class Sidecar(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Holds what the file beside an image tells of it, by the names that a message has for them."""

    captured_at: Stamp | None = None
    camera_id: Annotated[str, msgspec.Meta(max_length=LONGEST_NAME)] | None = None
    camera: Annotated[str, msgspec.Meta(max_length=LONGEST_NAME)] | None = None
    intrinsics: Intrinsics | None = None
    given_pose: GivenPose | None = None
    motion: Motion | None = None
    gravity: Gravity | None = None
    exposure: ExposureSettings | None = None
    T_base_camera: MountNumbers | None = None


class UnusableSidecar(ValueError):
    """A file beside an image that tells nothing that can be used; the text says why."""


_SIDECAR_BYTES = 64 << 10  # no sidecar file is larger


@dataclass(frozen=True)
class _FileState:
    """A file as it was when it last changed."""

    size: int  # -1: it could not be asked
    changed_ns: int
    since: float  # monotonic
    first: float


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """Each photograph once it is whole, for ever: unchanged for a while, and complete to its end marker.

    Hidden and temporary files are not looked at. Raises CameraUnavailable where the folder is not there, or goes.
    """
    return (item for item in opener(config)() if not isinstance(item, KeepAlive))


def opener(config: Config) -> Callable[[], Iterator[Frame | DroppedFrame | KeepAlive]]:
    """Returns the function that opens the folder, again after each loss: no photograph is taken twice or missed.

    Each look at the folder ends with KeepAlive.
    """
    return _Watched(config).stream


class _Watched:
    """The folder, and what needs not be looked at: what was taken from it, and what is not to be."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._opened = False
        self._done: dict[str, tuple[int, int] | None] = {}  # by name, the longest known first: which file it was
        self._here: set[str] = set()  # names at the last look

    def stream(self) -> Iterator[Frame | DroppedFrame | KeepAlive]:
        """Raises CameraUnavailable."""
        if self._opened:
            self._here = set()  # while it was away, any name may have been given to another photograph
        elif not self._config.include_existing:
            self._done = {path.name: _version(path) for path in _list_images(self._config.folder)}
            self._here = set(self._done)
        self._opened = True
        return self._frames()

    def _frames(self) -> Iterator[Frame | DroppedFrame | KeepAlive]:
        seen: dict[str, _FileState] = {}
        frame_id = 0
        while True:
            for path in self._list_candidates():
                version = _version(path)
                item = _read_when_complete(path, seen, self._config, frame_id)
                if item is not None:
                    self._done[path.name] = version
                    seen.pop(path.name, None)
                    frame_id += isinstance(item, Frame)
                    yield item
            yield KeepAlive()
            time.sleep(self._config.poll_s)

    def _list_candidates(self) -> list[Path]:
        """A name that was free may be given to another photograph; the same one may be back, with all of its folder."""
        listed = _list_images(self._config.folder)
        for path in listed:
            if path.name in self._done and path.name not in self._here and _version(path) != self._done[path.name]:
                del self._done[path.name]
        self._here = {path.name for path in listed}
        if len(self._done) > len(self._here) + REMEMBERED:
            gone = [name for name in self._done if name not in self._here]
            for name in gone[:-REMEMBERED]:
                del self._done[name]
        return [path for path in listed if path.name not in self._done]


def _version(path: Path) -> tuple[int, int] | None:
    """Tells a file from others of its name: size, and nanosecond of its last change; None where it does not tell."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


def _read_when_complete(
    path: Path, seen: dict[str, _FileState], config: Config, frame_id: int
) -> Frame | DroppedFrame | None:
    """The photograph; None while it is being written, or where it has gone."""
    if (unreadable := explain_unreadable_file(path)) is not None:
        return unreadable
    name, now = frame_name(path), time.monotonic()
    try:
        found = path.stat()
        before = seen.get(path.name)
        if before is None or (before.size, before.changed_ns) != (found.st_size, found.st_mtime_ns):
            seen[path.name] = _FileState(found.st_size, found.st_mtime_ns, now, before.first if before else now)
            return None
        if now - before.since < config.stable_s:
            return None
        data = read_image_file(path, config.max_pixels)
        check_whole(data)
        sidecar = _read_sidecar(path) if config.sidecars else None
    except _NoSidecar as error:
        return _drop_when_overdue(name, str(error), now - seen[path.name].first, config)
    except UnusableSidecar as error:
        return DroppedFrame(name, str(error))
    except FileNotFoundError:
        seen.pop(path.name, None)
        return None
    except OSError as error:  # often for a moment: its mode is still to be changed, a share answers late
        if is_shortage(error):  # no fault of the file, which has all of its time again
            seen.pop(path.name, None)
            return None
        _list_images(config.folder)  # raises where it is the folder that has gone
        first = seen.setdefault(path.name, _FileState(-1, -1, now, now)).first
        return _drop_when_overdue(name, f"cannot be read: {error.strerror}", now - first, config)
    except UnusableImage as error:
        return _drop_when_overdue(name, str(error), now - seen[path.name].first, config)
    item = _decode_frame(name, data, nearest_stamp(found.st_mtime_ns, Clock.FILE), config, frame_id)
    return item if sidecar is None or isinstance(item, DroppedFrame) else _apply_sidecar(item, sidecar)


class _NoSidecar(ValueError):
    """The file beside an image is not there yet."""


def _read_sidecar(path: Path) -> Sidecar:
    """The file beside an image. Raises _NoSidecar, UnusableSidecar, OSError."""
    beside = path.with_suffix(".json")
    shown = frame_name(beside)
    try:
        data = read_bounded(beside, _SIDECAR_BYTES, UnusableSidecar, shown)
    except FileNotFoundError:
        raise _NoSidecar(
            f"{shown} is not there, and camera.sidecars asks for it; write it before the image, under another name "
            "that is then changed"
        ) from None
    with guard_untrusted(UnusableSidecar, shown):
        try:
            return record_in(data, Sidecar)
        except (msgspec.DecodeError, ValueError) as error:
            raise UnusableSidecar(f"{shown} cannot be used: {sanitize_text(error)}") from error


def _apply_sidecar(made: Frame, sidecar: Sidecar) -> Frame | DroppedFrame:
    """The frame with what the file beside its image tells. Dropped where the lens is of another aspect ratio."""
    fields = {name: value for name in sidecar.__struct_fields__ if (value := getattr(sidecar, name)) is not None}
    lens = fields.pop("intrinsics", None)
    try:
        made = replace(made, **fields)
        if lens is not None:
            check_fits(lens, [(made.width, made.height)])
            made = assign_lens(made, lens)
    except ValueError as error:
        return DroppedFrame(made.name, f"the file beside it cannot be used: {error}")
    return made


def _drop_when_overdue(name: str, why: str, waited_s: float, config: Config) -> DroppedFrame | None:
    """None while it may still become whole, or readable."""
    return None if waited_s < config.file_timeout_s else DroppedFrame(name, f"{why}, after {waited_s:.0f} s")


def _decode_frame(name: str, data: bytes, written_at: Stamp, config: Config, frame_id: int) -> Frame | DroppedFrame:
    try:
        decoded, used = outlast(lambda: _convert_to_eight_bits(data, config.max_pixels), name)
    except UnusableImage as error:
        return DroppedFrame(name, str(error))
    image, intrinsics = decoded.image, decoded.intrinsics
    height, width = image.shape[:2]
    if config.intrinsics is not None and same_aspect(config.intrinsics, width, height):
        intrinsics = config.intrinsics.resized(width, height)
    captured_at = decoded.captured_at or name_time(name) or written_at
    known = image, intrinsics, data if used is None else None, captured_at
    metadata = {"exposure": decoded.exposure, "camera": decoded.camera, "camera_id": config.camera_id}
    item = make_frame(frame_id, name, time.monotonic_ns(), *known, **metadata)
    return apply_alpha_mask(item, decoded.mask)


def _convert_to_eight_bits(data: bytes, max_pixels: int) -> tuple[DecodedImage, ValueRange | None]:
    """The photograph, and the range of 16 bits that it was stretched from. Raises UnusableImage."""
    extent = measure_values(data, max_pixels)
    used = None if extent is None else find_range([extent])
    return decode_any_image(data, max_pixels, used), used


def _list_images(folder: Path) -> list[Path]:
    try:
        paths = outlast(lambda: image_paths(folder), frame_name(folder))
    except OSError as error:
        raise CameraUnavailable(f"cannot watch {str(folder)!r}: {error.strerror or error}") from error
    return [path for path in paths if not _TEMPORARY_SUFFIXES & {part.lower() for part in path.suffixes}]
