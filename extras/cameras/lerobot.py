"""What a camera saw in an episode of a LeRobot data set (v3.0), as a camera. Needs pyarrow."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.cameras import video
from splatnode.capture.film import part_of
from splatnode.capture.frame import Clock, DroppedFrame, Frame, Intrinsics, Pace, Stamp, pace_frames, rename_frame
from splatnode.capture.image_file import MaxPixels
from splatnode.capture.process.text import LONGEST_NAME, sanitize_name, sanitize_text
from splatnode.capture.video_process import MAX_VIDEO_PIXELS
from splatnode.extras.lerobot import Film, episode_name, film, is_data_set, list_parts, read_info

_LONGEST_STEM = LONGEST_NAME - 25  # characters: the number of the frame comes behind it
_EARLY = 0.25  # of a frame: what comes earlier by less than the table says is an episode's first frame nevertheless
_OFF = 0.75  # of a frame: a time may be off by less where the video's rate is not quite the data set's


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    folder: Path  # of the data set
    part: str  # the episode and the camera's key: 3/observation.images.top; of a data set with one camera, 3
    max_pixels: MaxPixels = MAX_VIDEO_PIXELS  # of a frame, at most; the decoder's memory is bounded accordingly
    pace: Pace = "fastest"  # recorded: at the pace of the video; fastest: as fast as frames are taken
    # The lens, of frames as they are shown: upright, of square pixels, at the same aspect ratio
    intrinsics: Intrinsics | None = None


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """The episode's frames, numbered and timed from its own beginning, also where one before them cannot be decoded.

    Raises UnusableDataSet, FileNotFoundError and ValueError where they cannot be had.
    """
    found = film(config.folder, config.part)
    part = video.Config(
        file=found.video,
        max_pixels=config.max_pixels,
        intrinsics=config.intrinsics,
        start_s=found.from_s,
        end_s=found.to_s,
    )
    early_s = _EARLY / found.rate if found.rate else 0.0
    return pace_frames(_frames(video.stream(part, early_s), found), config.pace)


def is_recording(path: Path) -> bool:
    """Whether this folder is a data set."""
    return is_data_set(path)


def configure_part(path: Path, part: str) -> dict[str, Any]:
    return {"folder": path, "part": part}


def explain_many(path: Path) -> str:
    """Says that a data set holds many films, and how one is named. Raises UnusableDataSet."""
    first = list_parts(path)[0]
    return (
        f"{str(path)!r} is a LeRobot data set; name an episode and a camera of it, such as "
        f"{str(part_of(path, first))!r}, or an episode with --cameras all, or give it to `splatnode batch`, "
        "which takes them all"
    )


def list_cameras(path: Path, part: str) -> list[tuple[list[str], str]]:
    """The cameras of an episode. Raises ValueError where `part` is no whole episode, UnusableDataSet."""
    if not part or "/" in part:
        first = part_of(path, episode_name(0))
        shown = repr(sanitize_text(str(part_of(path, part) if part else path)))
        raise ValueError(f"{shown}: of a data set, several cameras are those of an episode, such as {str(first)!r}")
    return [(key.split("."), f"{part}/{key}") for key in read_info(path).cameras]


def read_rig(path: Path, parts: Mapping[str, str]) -> None:
    """Returns nothing: a data set does not tell where its cameras stand."""


def _frames(frames: Iterator[Frame | DroppedFrame], found: Film) -> Iterator[Frame | DroppedFrame]:
    """Each has the number by which the data set knows its time; where it says no rate, that after the one before."""
    stem = sanitize_name(f"episode_{found.episode:06d}_{found.key}", _LONGEST_STEM)
    index, begins_ns = -1, math.inf
    for each in frames:
        if isinstance(each, DroppedFrame):
            yield replace(each, name=f"{stem}_rest")
            continue
        place = each.stamp_ns / 1e9 * found.rate - round(found.from_s * found.rate)
        index = max(index + 1, math.ceil(place - _OFF))
        if math.isinf(begins_ns):
            begins_ns = each.stamp_ns - (round(index / found.rate * 1e9) if found.rate else 0)
        stamp_ns = each.stamp_ns - round(begins_ns)
        item = rename_frame(each, index, f"{stem}_{index:06d}.png", stamp_ns)
        yield replace(item, captured_at=Stamp(stamp_ns, Clock.RECORDING)) if isinstance(item, Frame) else item
