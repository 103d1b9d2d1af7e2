"""A folder into which photographs are put while it is watched: by a copy, a network share, another program."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.cameras.folder import foreign_file, frame_name, image_paths
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, framed
from splatnode.capture.image_file import (
    MAX_PIXELS,
    MaxPixels,
    UnusableImage,
    check_whole,
    decode_photograph,
    read_image_file,
)
from splatnode.capture.name_time import name_time
from splatnode.capture.stamp import Clock, Stamp
from splatnode.capture.unavailable import CameraUnavailable

_TEMPORARY_SUFFIXES = {".tmp", ".part", ".partial", ".crdownload", ".filepart"}


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    folder: Path  # the folder that is watched
    existing: bool = True  # whether what lies there at the start is taken, too
    poll_s: Annotated[float, msgspec.Meta(gt=0)] = 0.2  # between looks at the folder
    settle_s: Annotated[float, msgspec.Meta(ge=0)] = 0.4  # a file is whole when it has not changed for so long
    give_up_s: Annotated[float, msgspec.Meta(gt=0)] = 60.0  # a file that is not whole after so long is left out
    max_pixels: MaxPixels = MAX_PIXELS  # larger images are left out
    intrinsics: Intrinsics | None = None  # the lens, of all images, instead of what their EXIF tells


@dataclass(frozen=True)
class _Seen:
    """A file as it was when it last changed."""

    size: int
    changed_ns: int
    since: float  # monotonic
    first: float


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """Each photograph once it is whole, for ever: unchanged for a while, and complete to its end marker.

    Hidden and temporary files are not looked at. Raises CameraUnavailable where the folder is not there, or goes.
    """
    skipped = set() if config.existing else {path.name for path in _listed(config.folder)}
    return _frames(config, skipped)


def _frames(config: Config, done: set[str]) -> Iterator[Frame | DroppedFrame]:
    seen: dict[str, _Seen] = {}
    frame_id = 0
    while True:
        listed = _listed(config.folder)
        done &= {path.name for path in listed}  # a name that is free again may be given to another photograph
        for path in listed:
            if path.name in done:
                continue
            item = _look(path, seen, config, frame_id)
            if item is not None:
                done.add(path.name)
                seen.pop(path.name, None)
                frame_id += isinstance(item, Frame)
                yield item
        time.sleep(config.poll_s)


def _look(path: Path, seen: dict[str, _Seen], config: Config, frame_id: int) -> Frame | DroppedFrame | None:
    """The photograph; None while it is being written, or where it has gone."""
    if (unreadable := foreign_file(path)) is not None:
        return unreadable
    name = frame_name(path)
    try:
        found, now = path.stat(), time.monotonic()
        before = seen.get(path.name)
        if before is None or (before.size, before.changed_ns) != (found.st_size, found.st_mtime_ns):
            seen[path.name] = _Seen(found.st_size, found.st_mtime_ns, now, before.first if before else now)
            return None
        if now - before.since < config.settle_s:
            return None
        data = read_image_file(path, config.max_pixels)
        check_whole(data)
    except FileNotFoundError:
        seen.pop(path.name, None)
        return None
    except OSError as error:
        return DroppedFrame(name, f"cannot be read: {error.strerror}")
    except UnusableImage as error:
        waited = now - seen[path.name].first
        return None if waited < config.give_up_s else DroppedFrame(name, f"{error}, after {waited:.0f} s")
    return _decoded(name, data, Stamp(max(0, found.st_mtime_ns), Clock.FILE), config, frame_id)


def _decoded(name: str, data: bytes, written_at: Stamp, config: Config, frame_id: int) -> Frame | DroppedFrame:
    try:
        image, intrinsics, captured_at, exposure = decode_photograph(data, config.max_pixels)
    except UnusableImage as error:
        return DroppedFrame(name, str(error))
    if config.intrinsics is not None:
        intrinsics = config.intrinsics.resized(image.shape[1], image.shape[0])
    captured_at = captured_at or name_time(name) or written_at
    return framed(frame_id, name, time.monotonic_ns(), image, intrinsics, data, captured_at, exposure=exposure)


def _listed(folder: Path) -> list[Path]:
    try:
        paths = image_paths(folder)
    except OSError as error:
        raise CameraUnavailable(f"cannot watch {str(folder)!r}: {error.strerror or error}") from error
    return [path for path in paths if not _TEMPORARY_SUFFIXES & {part.lower() for part in path.suffixes}]
