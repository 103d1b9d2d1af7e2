"""A recording in a file, by its name: a video, an image topic of an MCAP file, or an episode of a LeRobot data set.

film.mp4, film.mp4#t=10,20.5, drive.mcap#/front/image, pusht#episode_000003/observation.images.top

Videos are read here. Other recordings are read by cameras that an entry point of `splatnode.recordings` names.
"""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote, unquote

from splatnode.capture.cameras import video
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.process import plugins
from splatnode.capture.process.text import sanitize_text
from splatnode.capture.rig import Rig

_MARK = "#"  # between a file and the part of it that is meant
# Seconds of a video from its first frame, the first of which is in it, as W3C's Media Fragments have it: t=10,20.5.
# No more digits than there are in the largest that a video has: more could be infinite.
_SECONDS = re.compile(r"t=(\d{1,9}(?:\.\d{0,9})?)?(?:,(\d{1,9}(?:\.\d{0,9})?))?", re.ASCII)


class RecordingReader(Protocol):
    """The interface of a camera that reads recordings of one kind, which is the name of its entry point."""

    Config: Callable[..., Any]  # of the camera
    stream: Callable[[Any], Iterator[Frame | DroppedFrame]]

    def is_recording(self, path: Path) -> bool:
        """Whether this file or folder, by its name or by what lies in it, is of this kind."""
        ...

    def configure_part(self, path: Path, part: str) -> dict[str, Any]:
        """The camera's configuration for this part of it; an empty part means all."""
        ...

    def explain_many(self, path: Path) -> str | None:
        """Why this recording is no film as a whole, and what to name; None where it is one."""
        ...

    def list_cameras(self, path: Path, part: str) -> Sequence[tuple[Sequence[str], str]] | None:
        """The cameras of this part, each by its name in segments and its own part; None where it is one camera's.

        Raises ValueError where several cameras are those of another part.
        """
        ...

    def read_rig(self, path: Path, parts: Mapping[str, str]) -> Rig | None:
        """Returns where cameras stand to each other, by the part of each; None where such a recording does not tell it.

        Raises ValueError where this one does not tell it.
        """
        ...


def find_reader(path: Path) -> tuple[str, RecordingReader] | None:
    """The kind of camera that reads this file or folder, and its module; None where it is a video, or no recording.

    Raises BrokenPlugin.
    """
    for kind, entry in plugins.entry_points(plugins.RECORDINGS).items():
        reader: RecordingReader = entry.load()
        if reader.is_recording(path):
            return kind, reader
    return None


def file_and_part(path: Path) -> tuple[Path, str]:
    """The file or the data set, and what of it is meant; all where that is empty.

    A file whose own name has a # is itself.
    """
    if _is_there(path):
        return path, ""
    text = str(path)
    for place in (place for place, letter in enumerate(text) if letter == _MARK):
        file = Path(text[:place])
        if _is_there(file) and (file.is_file() or find_reader(file) is not None):
            return file, unquote(text[place + 1 :])
    return path, ""


def _is_there(path: Path) -> bool:
    """Whether a path leads somewhere; one that is too long for the system does not."""
    try:
        return path.exists()
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        return False


def part_of(file: Path, part: str) -> Path:
    """The path by which `file_and_part` finds this part, whatever characters it has."""
    plain = f"{file}{_MARK}{quote(part, safe='/')}"
    return Path(plain if os.path.normpath(plain) == plain else f"{file}{_MARK}{quote(part, safe='')}")


def is_film(path: Path) -> bool:
    """Whether this is a file, or a part of one or of a data set, and not a folder."""
    file, part = file_and_part(path)
    return bool(part) or (_is_there(file) and file.is_file())


def camera(path: Path) -> tuple[str, dict[str, Any]]:
    """The kind of camera that gives its frames, and its configuration.

    Raises ValueError for a part of a video that is no range of seconds.
    """
    kind, _, told = _find_camera(path)
    return kind, told


def _find_camera(path: Path) -> tuple[str, Any, dict[str, Any]]:
    """As `camera`, with the module between."""
    file, part = file_and_part(path)
    if (found := find_reader(file)) is not None:
        kind, reader = found
        return kind, reader, reader.configure_part(file, part)
    return "video", video, {"file": file, **(_parse_seconds(file, part) if part else {})}


def _parse_seconds(file: Path, part: str) -> dict[str, float]:
    """From when to when a part of a video is. Raises ValueError."""
    found = _SECONDS.fullmatch(part)
    told = {} if found is None else {"start_s": found[1], "end_s": found[2]}
    span = {name: float(text) for name, text in told.items() if text}
    if not span or span.get("start_s", 0.0) >= span.get("end_s", math.inf):
        raise ValueError(
            f"{sanitize_text(str(file))!r}: behind the # must be seconds of the video, the first before the last, "
            "such as "
            f"#t=10,20.5, #t=10 or #t=,20.5; got {sanitize_text(part, 100)!r}. Of an MCAP file it is a topic"
        )
    return span


def stream(path: Path) -> Iterator[Frame | DroppedFrame]:
    """Its frames. Raises FileNotFoundError, or ValueError where they cannot be had."""
    _, module, told = _find_camera(path)
    return module.stream(module.Config(**told))
