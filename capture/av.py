"""A video decoded by PyAV: a part without all that lies before it, and AV1, which OpenCV's wheels cannot decode."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from av.error import FFmpegError

Decoded = tuple[int, npt.NDArray[np.uint8]]  # place in the video, (H, W, 3) BGR


class TooLarge(ValueError):
    """Its frames have more pixels than may be decoded."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__(f"{width} x {height}")
        self.width, self.height = width, height


class Video:
    """An open video. Close it."""

    def __init__(self, file: Path, threads: int) -> None:
        """Raises av's errors where it is none."""
        self._container = av.open(str(file))
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_count = threads
        self.rate = float(self._stream.average_rate or 0)  # frames a second

    def close(self) -> None:
        self._container.close()

    def frames(self, from_s: float, to_s: float, every: int, max_pixels: int) -> Iterator[Decoded]:
        """Every `every`-th frame from one time to before another; packets that cannot be decoded are left out.

        Raises TooLarge.
        """
        first, end = round(from_s * self.rate), math.inf if math.isinf(to_s) else round(to_s * self.rate)
        begins, unit_s = self._stream.start_time or 0, float(self._stream.time_base or 0)
        self._check(self._stream.width, self._stream.height, max_pixels)
        if first:
            self._container.seek(begins + math.floor(from_s / unit_s), stream=self._stream)
        for frame in self._decoded():
            if frame.pts is None:
                continue
            index = round((frame.pts - begins) * unit_s * self.rate)
            if index >= end:
                return
            if index >= first and (index - first) % every == 0:
                self._check(frame.width, frame.height, max_pixels)
                yield index, frame.to_ndarray(format="bgr24").astype(np.uint8, copy=False)

    def _decoded(self) -> Iterator[av.VideoFrame]:
        for packet in self._container.demux(self._stream):
            try:
                yield from self._stream.codec_context.decode(packet)
            except FFmpegError:
                continue

    @staticmethod
    def _check(width: int, height: int, max_pixels: int) -> None:
        if width * height > max_pixels:
            raise TooLarge(width, height)
