"""The photographs that a command line names, and what it says of their lens."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics


def photographs(paths: Sequence[Path], given: Intrinsics | None) -> Iterator[Frame | DroppedFrame]:
    """The photographs that the paths name, each a file or a folder, in their order; `given` is their lens.

    Raises FileNotFoundError for a path that is not there.
    """
    for path in paths:
        if path.is_dir():
            yield from folder.stream(folder.Config(folder=path, intrinsics=given))
        elif path.is_file():
            name = folder.frame_name(path)
            yield from folder.stream(folder.Config(folder=path.parent, names=(name,), intrinsics=given))
        else:
            raise FileNotFoundError(f"{str(path)!r} is not there; give photographs, or folders that hold some")


def assumed_lens(frame: Frame, fov_deg: float | None) -> Intrinsics | None:
    """What is known of the photograph's lens; an angle of view, across the longer side, is right to a few per cent."""
    if fov_deg is None:
        return frame.intrinsics
    focal = max(frame.width, frame.height) / 2.0 / math.tan(math.radians(fov_deg) / 2.0)
    middle = frame.width / 2.0, frame.height / 2.0
    return Intrinsics(frame.width, frame.height, focal, focal, *middle, source="exif")
