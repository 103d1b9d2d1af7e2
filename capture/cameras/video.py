"""A video file as a camera: its frames as a player shows them, at the times that the file tells."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.frame import (
    LARGEST_NS,
    Clock,
    DroppedFrame,
    Frame,
    Intrinsics,
    Pace,
    Stamp,
    make_frame,
    pace_frames,
)
from splatnode.capture.image_file import MaxPixels
from splatnode.capture.lenses import check_fits, same_aspect
from splatnode.capture.process.terminal import event
from splatnode.capture.process.text import LONGEST_NAME, sanitize_name
from splatnode.capture.video_process import MAX_VIDEO_PIXELS, Span, VideoError, VideoFrame, decode_video

log = logging.getLogger(__name__)

_LONGEST_STEM = LONGEST_NAME - 25  # characters: the number of the frame comes behind it


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    file: Path  # the video
    stride: Annotated[int, msgspec.Meta(ge=1)] = 1  # 3: every third frame is taken
    start_s: Annotated[float, msgspec.Meta(ge=0, le=1e9)] = 0.0  # where it begins, in seconds from the first frame
    end_s: Annotated[float, msgspec.Meta(gt=0, le=1e9)] | None = None  # where it ends, likewise; None: with the video
    max_pixels: MaxPixels = MAX_VIDEO_PIXELS  # of a frame, at most; the decoder's memory is bounded accordingly
    pace: Pace = "fastest"  # recorded: at the pace of the video; fastest: as fast as frames are taken
    # The lens, of frames as they are shown: upright, of square pixels, at the same aspect ratio
    intrinsics: Intrinsics | None = None


def stream(config: Config, early_s: float = 0.0) -> Iterator[Frame | DroppedFrame]:
    """The frames at their times in the video; those that cannot be decoded are left out, and counted at the end.

    A frame that is at most `early_s` before `start_s` or `end_s` counts as at it, for whoever knows these roughly.
    Raises FileNotFoundError, or ValueError where the file is no video that can be decoded, or the lens cannot be of
    its images. What goes wrong after a frame is named as a dropped frame, and ends the stream.
    """
    if not config.file.is_file():
        raise FileNotFoundError(f"no file {str(config.file)!r}; give a video, such as an MP4")
    return pace_frames(_frames(config, early_s), config.pace)


def _frames(config: Config, early_s: float) -> Iterator[Frame | DroppedFrame]:
    frame_id = 0
    from_ns = max(0, round((config.start_s - early_s) * 1e9))
    span = Span(from_ns, None if config.end_s is None else max(0, round((config.end_s - early_s) * 1e9)))
    try:
        for found in decode_video(config.file, config.stride, config.max_pixels, span):
            if frame_id == 0:
                _begin(found, config)
            yield _frame(found, frame_id, config)
            frame_id += 1
    except VideoError as error:
        if frame_id == 0:
            raise VideoError(f"{str(config.file)!r} is no video that can be used: {error}") from error
        yield DroppedFrame(f"{_stem(config)}_rest", str(error))
    if frame_id == 0:
        lacking = f"is no video that can be decoded, or has no frame{_describe_range(config)}"
        raise ValueError(f"{str(config.file)!r} {lacking}; convert it to MP4 (H.264)")


def _describe_range(config: Config) -> str:
    if config.end_s is not None:
        return f" between {config.start_s:g} and {config.end_s:g} s"
    return f" from {config.start_s:g} s on" if config.start_s else ""


def _begin(first: VideoFrame, config: Config) -> None:
    """Tells what was done to the frames. Raises ValueError where the lens cannot be of them."""
    height, width = first.image.shape[:2]
    if config.intrinsics is not None:
        check_fits(config.intrinsics, [(width, height)])
    if first.pixel_aspect != 1.0:
        shape = f"{first.pixel_aspect:.4g} times as wide as high"
        fields = {"video": config.file.name, "pixels": shape, "frames": f"{width}x{height}"}
        event(log, logging.WARNING, "pixels_made_square", **fields)


def _stem(config: Config) -> str:
    return sanitize_name(config.file.stem, _LONGEST_STEM)


def _frame(found: VideoFrame, frame_id: int, config: Config) -> Frame | DroppedFrame:
    height, width = found.image.shape[:2]
    known = config.intrinsics
    lens = known.resized(width, height) if known is not None and same_aspect(known, width, height) else None
    name = f"{_stem(config)}_{found.index:06d}.png"
    captured_at = Stamp(found.time_ns, Clock.RECORDING) if found.time_ns <= LARGEST_NS else None
    return make_frame(frame_id, name, found.time_ns, found.image, lens, captured_at=captured_at)
