"""A recording in a file, by its name: a video, film.mp4, or an image topic of an MCAP file, drive.mcap#/front/image."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote, unquote

from splatnode.capture.cameras import mcap, video
from splatnode.capture.frame import DroppedFrame, Frame

MCAP = ".mcap"
_MARK = "#"  # between a file and the part of it that is meant


def file_and_part(path: Path) -> tuple[Path, str]:
    """The file, and what of it is meant; all of it where that is empty. A file whose own name has a # is itself."""
    if path.exists():
        return path, ""
    text = str(path)
    for place in (place for place, letter in enumerate(text) if letter == _MARK):
        if (file := Path(text[:place])).is_file():
            return file, unquote(text[place + 1 :])
    return path, ""


def part_of(file: Path, part: str) -> Path:
    """The path by which `file_and_part` finds this part, whatever characters it has."""
    plain = f"{file}{_MARK}{quote(part, safe='/')}"
    return Path(plain if os.path.normpath(plain) == plain else f"{file}{_MARK}{quote(part, safe='')}")


def is_film(path: Path) -> bool:
    """Whether this is a file, or a part of one, and not a folder."""
    return file_and_part(path)[0].is_file()


def stream(path: Path) -> Iterator[Frame | DroppedFrame]:
    """Its frames. Raises FileNotFoundError, or ValueError where they cannot be had."""
    file, part = file_and_part(path)
    if file.suffix.lower() == MCAP:
        return mcap.stream(mcap.Config(file=file, topic=part))
    if part:
        raise ValueError(f"{str(path)!r}: of an MCAP file a topic can be named behind the #, of a video nothing")
    return video.stream(video.Config(file=file))
