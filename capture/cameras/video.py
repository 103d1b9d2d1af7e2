"""A video file as a camera."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np

from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, framed
from splatnode.capture.given_lens import check_fits
from splatnode.capture.image_file import MaxPixels
from splatnode.capture.pace import Pace, paced
from splatnode.capture.process.printable import LONGEST_NAME, printable_name
from splatnode.capture.stamp import Clock, Stamp
from splatnode.capture.video_process import MAX_VIDEO_PIXELS, Span, VideoError, VideoFrame, decoded

_LONGEST_STEM = LONGEST_NAME - 25  # characters: the number of the frame comes behind it


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    file: Path  # the video
    every: Annotated[int, msgspec.Meta(ge=1)] = 1  # 3: every third frame is taken; the others are not decoded
    from_s: Annotated[float, msgspec.Meta(ge=0)] = 0.0  # where it begins, in seconds from the video's beginning
    to_s: Annotated[float, msgspec.Meta(gt=0)] | None = None  # where it ends, likewise; None: with the video
    max_pixels: MaxPixels = MAX_VIDEO_PIXELS  # of a frame, at most; the decoder's memory is bounded accordingly
    pace: Pace = "fastest"  # recorded: at the pace of the video; fastest: as fast as frames are taken
    intrinsics: Intrinsics | None = None  # the lens, of a calibration at the same aspect ratio


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """The frames at their times in the video; those that cannot be decoded are left out by the decoder, unnamed.

    Raises FileNotFoundError, or ValueError where the file is no video that can be decoded, or the lens cannot be of
    its images. What goes wrong after a frame is named as a dropped frame, and ends the stream.
    """
    if not config.file.is_file():
        raise FileNotFoundError(f"no file {str(config.file)!r}; give a video, such as an MP4")
    return paced(_frames(config), config.pace)


def _frames(config: Config) -> Iterator[Frame | DroppedFrame]:
    frame_id = 0
    span = Span(config.from_s, math.inf if config.to_s is None else config.to_s)
    try:
        for found in decoded(config.file, config.every, config.max_pixels, span):
            yield _frame(found, frame_id, config)
            frame_id += 1
    except VideoError as error:
        if frame_id == 0:
            raise VideoError(f"{str(config.file)!r} is no video that can be used: {error}") from error
        yield DroppedFrame(f"{_stem(config)}_rest", str(error))
    if frame_id == 0:
        where = "" if span.is_all else f" between {span.from_s:g} and {span.to_s:g} s"
        raise ValueError(
            f"{str(config.file)!r} is no video that can be decoded, or has no frame{where}; convert it to MP4 (H.264)"
        )


def _stem(config: Config) -> str:
    return printable_name(config.file.stem, _LONGEST_STEM)


def _frame(found: VideoFrame, frame_id: int, config: Config) -> Frame | DroppedFrame:
    """Stamps are counted, not read: containers with edited time lines give stamps that go back."""
    rgb = cv2.cvtColor(found.image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    height, width = rgb.shape[:2]
    if config.intrinsics is not None and frame_id == 0:
        check_fits(config.intrinsics, [(width, height)])
    intrinsics = None if config.intrinsics is None else config.intrinsics.resized(width, height)
    name = f"{_stem(config)}_{found.index:06d}.png"
    stamp_ns = round(found.index / found.rate * 1e9)
    return framed(frame_id, name, stamp_ns, rgb, intrinsics, captured_at=Stamp(stamp_ns, Clock.RECORDING))
