"""Small video files with known frames at known times, made with PyAV."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]  # (H, W, 3) RGB
CLOCK = Fraction(1, 1000)  # seconds of the numbers that are times here
QUARTER = 1 << 16  # one, in a display matrix


def level_images(count: int, size: tuple[int, int] = (96, 64)) -> list[Image]:
    """Images (H, W, 3) of a width and height that get brighter by 255 / count, darker in the upper left quarter."""
    width, height = size
    found = []
    for index in range(count):
        image = np.full((height, width, 3), level_of(index, count), np.uint8)
        image[: height // 2, : width // 2] = 0
        found.append(image)
    return found


def level_of(index: int, count: int) -> int:
    """The grey level of one of `level_images`."""
    return 40 + 200 * index // count


def write_clip(
    file: Path,
    codec: str,
    images: Sequence[Image],
    times_ms: Sequence[int],
    *,
    options: dict[str, str] | None = None,
    pixel_aspect: Fraction | None = None,
) -> Path:
    """Encodes images at times; H.264 and HEVC with frames that refer to later ones, and a key frame every six."""
    chosen = {
        "libx264": {"bf": "2", "g": "6", "sc_threshold": "0"},
        "mpeg4": {"bf": "2", "g": "6"},
        "libx265": {"x265-params": "bframes=2:keyint=6:log-level=none"},
        "libsvtav1": {"preset": "12", "g": "6", "svtav1-params": "lp=1"},
        "libvpx-vp9": {"g": "6", "deadline": "realtime", "cpu-used": "8"},
    }.get(codec, {})
    with scheduled_as_before(), av.open(str(file), "w") as container:
        stream: Any = container.add_stream(codec, rate=25, options={**chosen, **(options or {})})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.bit_rate = 4_000_000
        stream.codec_context.time_base = CLOCK
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        for image, time_ms in zip(images, times_ms, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = time_ms, CLOCK
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return file


def write_sound(file: Path, codec: str = "aac") -> Path:
    """A tenth of a second of silence."""
    with av.open(str(file), "w") as container:
        stream: Any = container.add_stream(codec, rate=48_000)
        frame: Any = av.AudioFrame(format=stream.format.name, layout="stereo", samples=1024)
        for plane in frame.planes:
            plane.update(bytes(plane.buffer_size))
        for index in range(5):
            frame.pts, frame.rate = 1024 * index, 48_000
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return file


def turn(file: Path, matrix: tuple[int, int, int, int]) -> Path:
    """Gives an MP4's or MOV's picture a display matrix: where the stored right and down go, x then y of each."""
    data = bytearray(file.read_bytes())
    identity = struct.pack(">9i", QUARTER, 0, 0, 0, QUARTER, 0, 0, 0, 1 << 30)
    at = data.index(identity, data.index(b"tkhd"))
    a, b, c, d = (QUARTER * each for each in matrix)
    data[at : at + len(identity)] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    file.write_bytes(data)
    return file


def packet_times_s(file: Path) -> list[float]:
    """When the frames of a file are shown by the times of its packets, in seconds from the first one, rising."""
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        pts = sorted(packet.pts for packet in container.demux(stream) if packet.pts is not None)
        return [float((each - pts[0]) * stream.time_base) for each in pts]


@contextlib.contextmanager
def scheduled_as_before() -> Iterator[None]:
    """SVT-AV1, where it runs as root, gives the thread that encodes a priority before all others, for ever."""
    if not hasattr(os, "sched_getscheduler"):
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)
