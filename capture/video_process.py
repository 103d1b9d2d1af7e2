"""A video decoded in a process of its own, which has a limit on its memory.

FFmpeg takes memory for the frames that a stream describes, as many as it refers to, before anybody sees their size, and
what it does with a crafted stream is its own affair: here it can end without the process that wants the frames.
"""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from splatnode.capture.process import python

MAX_VIDEO_PIXELS = 36_000_000  # of a frame: 8192 x 4320
BYTES_A_PIXEL = 80  # of memory at most for the decoder: its frames in flight, in colour, and what it refers to
BASE_BYTES = 500_000_000  # further ones, whatever the size of a frame
_MAX_THREADS = 8  # each has a frame of its own
_MAX_NS = 2**63  # that is written; a crafted file may tell more
_FRAME, _TOO_LARGE, _NO_PICTURES, _END = b"F", b"L", b"N", b"E"  # kinds of what the decoder's process says
_HEAD = struct.Struct("<cQQIId")  # kind, index, time in ns, width, height, pixel aspect; pixels follow those of a frame


class VideoError(ValueError):
    """The file is no video that can be decoded, or its frames are too large; the message says why."""


@dataclass(frozen=True)
class VideoFrame:
    index: int  # in the video, where each frame has its own
    time_ns: int  # since the first frame of the video, as the container tells it
    image: npt.NDArray[np.uint8]  # (H, W, 3) RGB, upright, of square pixels
    pixel_aspect: float = 1.0  # width of a pixel in the file over its height; 1 where nothing was resampled


@dataclass(frozen=True)
class Span:
    """A part of a video, in nanoseconds from its first frame."""

    from_ns: int = 0
    to_ns: int | None = None  # which is in it no more; None: to the end

    def __str__(self) -> str:
        end = "its end" if self.to_ns is None else f"{self.to_ns / 1e9:g} s"
        return f"{self.from_ns / 1e9:g} s and {end}"


def decode_video(file: Path, every: int, max_pixels: int, span: Span = Span()) -> Iterator[VideoFrame]:
    """Yields every `every`-th frame of `span`, each of its own size. Those that cannot be decoded are left out.

    Of what is no video that is read here there are none.
    Raises VideoError: after the frames, where some are missing or what follows cannot be read.
    """
    numbers = every, max_pixels, span.from_ns, -1 if span.to_ns is None else span.to_ns
    command = python.command("splatnode.capture.video_process", os.fsdecode(file.absolute()), *map(str, numbers))
    with python.start_process(command, subprocess.DEVNULL) as child:
        assert child.stdout is not None
        has_ended = yield from _receive_frames(child.stdout, max_pixels)
        if child.wait() != 0 or not has_ended:
            raise VideoError(
                f"its decoder ended ({child.returncode}); is it whole, with frames of {max_pixels} pixels?"
            )


def _receive_frames(stream: IO[bytes], max_pixels: int) -> Generator[VideoFrame, None, bool]:
    """The frames that `main` writes; returns whether it came to its end. Raises VideoError for what it reports."""
    while len(head := stream.read(_HEAD.size)) == _HEAD.size:
        kind, index, time_ns, width, height, aspect = _HEAD.unpack(head)
        if kind == _END:
            _check_complete(num_lost=index, is_cut=bool(time_ns))
            return True
        if kind == _NO_PICTURES:
            raise VideoError("it has no pictures that follow each other, but sound, data or a cover alone")
        if kind == _TOO_LARGE or width * height > max_pixels:
            raise VideoError(f"its frames are {width} x {height}: more than {max_pixels} pixels; make them smaller")
        data = stream.read(width * height * 3)
        if len(data) < width * height * 3:
            return False
        yield VideoFrame(index, time_ns, np.frombuffer(data, np.uint8).reshape(height, width, 3), aspect)
    return False


def _check_complete(num_lost: int, is_cut: bool) -> None:
    """Raises VideoError where not all frames came."""
    if is_cut:
        raise VideoError("it ends before the frames that it states: it is cut, or damaged there")
    if num_lost:
        raise VideoError(f"{num_lost} of its packets could not be decoded: it is damaged")


def main() -> None:
    """The decoder's process: FILE EVERY MAX_PIXELS FROM_NS TO_NS; writes what `_receive_frames` reads."""
    from splatnode.capture.av import NoPictures, NotReadable, TooLarge, Video

    file, every, max_pixels, from_ns, to_ns = sys.argv[1], *map(int, sys.argv[2:])
    python.limit_memory(BASE_BYTES + BYTES_A_PIXEL * max_pixels)
    out = sys.stdout.buffer
    try:
        video = Video(Path(file), threads=min(_MAX_THREADS, os.cpu_count() or 1))
    except (NotReadable, NoPictures) as error:
        out.write(_HEAD.pack(_END if isinstance(error, NotReadable) else _NO_PICTURES, 0, 0, 0, 0, 1.0))
        return
    try:
        for frame in video.frames(from_ns, None if to_ns < 0 else to_ns, every, max_pixels):
            height, width = frame.image.shape[:2]
            time_ns = min(frame.time_ns, _MAX_NS)
            out.write(_HEAD.pack(_FRAME, frame.index, time_ns, width, height, frame.pixel_aspect))
            out.write(frame.image.data)
        out.write(_HEAD.pack(_END, video.lost, video.is_cut, 0, 0, 1.0))
    except TooLarge as error:
        out.write(_HEAD.pack(_TOO_LARGE, 0, 0, error.width, error.height, 1.0))
    finally:
        video.close()


if __name__ == "__main__":
    main()
