"""The photographs that a command line names, and what it says of their lens."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.given_lens import assign_lens, check_fits, same_aspect
from splatnode.capture.lenses.undistort import undistort_frame


def stream_query_frames(paths: Sequence[Path], given: Intrinsics | None) -> Iterator[Frame | DroppedFrame]:
    """The photographs that the paths name, each a file or a folder, in their order.

    `given` is the lens of those that have its aspect ratio. Raises FileNotFoundError for a path that is not there.
    """
    for frame in _stream_paths(paths):
        yield frame if given is None else assign_lens(frame, given)


def check_lens(given: Intrinsics, frames: Iterable[Frame | DroppedFrame]) -> None:
    """Looks for a photograph that the lens can be of, and takes no more frames than that needs.

    Raises ValueError where there are photographs and it is of none, or where its distortion cannot be undone.
    """
    others: set[tuple[int, int]] = set()
    for frame in frames:
        if isinstance(frame, Frame) and same_aspect(given, frame.width, frame.height):
            undistort_frame(replace(frame, intrinsics=given, right=None))
            return
        if isinstance(frame, Frame):
            others.add((frame.width, frame.height))
    check_fits(given, others)


def _stream_paths(paths: Sequence[Path]) -> Iterator[Frame | DroppedFrame]:
    for path in paths:
        if path.is_dir():
            yield from folder.stream(folder.Config(folder=path))
        elif path.is_file():
            yield from folder.stream(folder.Config(folder=path.parent, names=(folder.frame_name(path),)))
        else:
            raise FileNotFoundError(f"{str(path)!r} is not there; give photographs, or folders that hold some")


def choose_intrinsics(frame: Frame, fov_deg: float | None) -> Intrinsics | None:
    """Returns the image's intrinsics; an angle of view, across the longer side, holds to a few per cent."""
    if fov_deg is None:
        return frame.intrinsics
    focal = max(frame.width, frame.height) / 2.0 / math.tan(math.radians(fov_deg) / 2.0)
    middle = frame.width / 2.0, frame.height / 2.0
    return Intrinsics(frame.width, frame.height, focal, focal, *middle, source="exif")
