"""A video decoded in a process of its own, which has a limit on its memory.

FFmpeg takes memory for the frames that a stream describes, as many as it refers to, before anybody sees their size, and
what it does with a crafted stream is its own affair: here it can end without the process that wants the frames.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.process import apart
from splatnode.capture.process.packages import remedy

MAX_VIDEO_PIXELS = 36_000_000  # of a frame: 8192 x 4320
BYTES_A_PIXEL = 80  # of memory at most for the decoder: its frames in flight, in colour, and what it refers to
BASE_BYTES = 500_000_000  # further ones, whatever the size of a frame
_MAX_THREADS = 8  # each has a frame of its own
_LEAD = 10  # frames before a part of a video, whose times tell whether the way there was exact
_AV1 = int.from_bytes(b"AV01", "little")  # OpenCV's number of the codec, which its wheels know and cannot decode
_NEEDS_AV, _ENDED_EARLY = 3, 4  # exit codes
_MOST = 0.9  # of the frames that a container states: some state a few more than there are
_START, _FRAME = struct.Struct("<d"), struct.Struct("<QII")  # frames a second; index, width, height


class VideoError(ValueError):
    """The file is no video that can be decoded, or its frames are too large; the message says why."""


@dataclass(frozen=True)
class VideoFrame:
    index: int  # in the video
    rate: float  # frames a second
    image: npt.NDArray[np.uint8]  # (H, W, 3) BGR, as it is decoded


@dataclass(frozen=True)
class Span:
    """A part of a video, in seconds from its beginning."""

    from_s: float = 0.0
    to_s: float = math.inf  # which is in it no more

    @property
    def is_all(self) -> bool:
        return self == Span()


def decoded(file: Path, every: int, max_pixels: int, span: Span = Span()) -> Iterator[VideoFrame]:
    """Every `every`-th frame of `span`, all of one size. Those that cannot be decoded are left out.

    Raises VideoError, after the frames before it where it is about a later one.
    """
    numbers = every, max_pixels, span.from_s, span.to_s
    command = apart.command(__name__, os.fsdecode(file.absolute()), *map(str, numbers))
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # what FFmpeg says of a stranger's file is a stranger's text
        start_new_session=True,  # Ctrl-C is for us
    )
    with child, contextlib.ExitStack() as cleanup:
        cleanup.callback(child.kill)
        assert child.stdout is not None
        yield from _received(child.stdout, max_pixels)
        if child.wait() == _NEEDS_AV:
            raise VideoError(f"its codec is AV1, which needs PyAV. {remedy('av')}")
        if child.returncode == _ENDED_EARLY:
            raise VideoError("it ends before the frames that it states: it is cut, or damaged there")
        if child.returncode != 0:
            raise VideoError(
                f"its decoder ended ({child.returncode}); is it whole, with frames of {max_pixels} pixels?"
            )


def _received(stream: IO[bytes], max_pixels: int) -> Iterator[VideoFrame]:
    start = stream.read(_START.size)
    if len(start) < _START.size:
        return
    (rate,) = _START.unpack(start)
    if not 0.001 <= rate <= 1000:
        raise VideoError(f"it has {rate:g} frames a second; 0.001 to 1000 can be read")
    while len(head := stream.read(_FRAME.size)) == _FRAME.size:
        index, width, height = _FRAME.unpack(head)
        if width * height > max_pixels:
            raise VideoError(f"its frames are {width} x {height}: more than {max_pixels} pixels; make them smaller")
        data = stream.read(width * height * 3)
        if len(data) < width * height * 3:
            return
        yield VideoFrame(index, rate, np.frombuffer(data, np.uint8).reshape(height, width, 3))


def main() -> None:
    """The decoder's process: FILE EVERY MAX_PIXELS FROM_S TO_S; writes what `_received` reads."""
    file, every, max_pixels = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    span = Span(float(sys.argv[4]), float(sys.argv[5]))
    apart.limit_memory(BASE_BYTES + BYTES_A_PIXEL * max_pixels)
    threads = min(_MAX_THREADS, os.cpu_count() or 1)
    video = _opened(file, threads)
    if not video.isOpened():
        return
    is_av1 = round(video.get(cv2.CAP_PROP_FOURCC)) == _AV1
    has_av = find_spec("av") is not None
    if is_av1 and not has_av:
        sys.exit(_NEEDS_AV)
    out = sys.stdout.buffer
    if has_av and (is_av1 or not span.is_all):
        video.release()
        _write_by_av(out, Path(file), every, max_pixels, span, threads)
    elif not _write_by_opencv(out, video, partial(_opened, file, threads), every, max_pixels, span):
        out.flush()
        sys.exit(_ENDED_EARLY)


def _opened(file: str, threads: int) -> cv2.VideoCapture:
    return cv2.VideoCapture(file, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, threads])


def _write_by_opencv(
    out: IO[bytes],
    video: cv2.VideoCapture,
    again: Callable[[], cv2.VideoCapture],
    every: int,
    max_pixels: int,
    span: Span,
) -> bool:
    """Whether all was there. `again` opens the video from its beginning."""
    rate = video.get(cv2.CAP_PROP_FPS)
    out.write(_START.pack(rate))
    width, height = (round(video.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > max_pixels:  # known before a frame is decoded
        out.write(_FRAME.pack(0, width, height))
        return True
    first, end = round(span.from_s * rate), math.inf if math.isinf(span.to_s) else round(span.to_s * rate)
    index = first if _sought(video, first, rate) else 0
    if index < first:  # all frames before it are decoded, too
        video = again()
    while index < end and video.grab():
        if index >= first and (index - first) % every == 0:
            found, image = video.retrieve()
            if found:
                height, width = image.shape[:2]
                out.write(_FRAME.pack(index, width, height) + image.tobytes())
        index += 1
    return index == 0 or index >= min(end, _MOST * video.get(cv2.CAP_PROP_FRAME_COUNT))


def _sought(video: cv2.VideoCapture, first: int, rate: float) -> bool:
    """Whether the next frame is the `first` of a span without all that lies before; if not, the video is anywhere.

    OpenCV promises no exact way to a frame. So it goes to one a little before, and from there on the times tell.
    """
    if first <= _LEAD or not video.set(cv2.CAP_PROP_POS_FRAMES, first - _LEAD):
        return False
    before = None
    while video.grab():
        place = round(video.get(cv2.CAP_PROP_POS_MSEC) / 1000.0 * rate)
        if before is not None and place != before + 1:
            return False
        if place >= first - 1:
            return place == first - 1
        before = place
    return False


def _write_by_av(out: IO[bytes], file: Path, every: int, max_pixels: int, span: Span, threads: int) -> None:
    from splatnode.capture.av import TooLarge, Video

    video = Video(file, threads)
    out.write(_START.pack(video.rate))
    try:
        for index, image in video.frames(span.from_s, span.to_s, every, max_pixels):
            height, width = image.shape[:2]
            out.write(_FRAME.pack(index, width, height) + image.tobytes())
    except TooLarge as error:
        out.write(_FRAME.pack(0, error.width, error.height))
    finally:
        video.close()
