"""Videos whose frames are larger than a camera's, or change their size, or come at a rate that none has."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from tests.support.crafted.crafted import Crafted

LARGE = 8000  # pixels a side: 0.8 GB for two frames in colour


def videos() -> Iterator[Crafted]:
    """Each is an AVI of at most three frames."""
    small = cv2.imencode(".jpg", np.full((48, 64), 90, np.uint8))[1].tobytes()
    large = cv2.imencode(".jpg", np.zeros((LARGE, LARGE), np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 5])[1].tobytes()
    yield Crafted("large.avi", avi([large] * 3, LARGE, LARGE), "frames of 64 million pixels")
    yield Crafted("hidden.avi", avi([large] * 3, 64, 48), "the same in a container that says 64 x 48")
    yield Crafted("later.avi", avi([small, large, small], 64, 48), "a large frame between two small ones")
    yield Crafted(
        "container.avi", avi([small] * 3, 2**31 - 1, 2**31 - 1), "a container that says 2^31 - 1 pixels a side"
    )
    yield Crafted(
        "png.avi", avi([b"\x89PNG\r\n\x1a\n" + bytes(100)], LARGE, LARGE, b"MPNG"), "a large frame that is none"
    )
    for name, rate, scale in (("fast", 2**32 - 1, 1), ("slow", 1, 2**32 - 1), ("still", 0, 1), ("never", 1, 0)):
        yield Crafted(f"{name}.avi", avi([small] * 3, 64, 48, rate=rate, scale=scale), "a rate that no camera has")
    yield Crafted("count.avi", avi([small] * 3, 64, 48, count=2**32 - 1), "4 billion frames, of which three are there")
    yield Crafted(
        "damaged.avi", avi([small, small[:100], b"\xff" * 1000], 64, 48), "frames that are none behind a good one"
    )
    yield Crafted("raw.avi", avi([bytes(64 * 48 * 3)] * 2, LARGE, LARGE, b"DIB "), "frames shorter than their size")
    turned = [np.random.default_rng(0).bytes(64 * 48 * 3)] * 2
    yield Crafted("turned.avi", avi(turned, 64, 48, bytes(4)), "raw rows from below, which end OpenCV 5.0 by a signal")
    yield Crafted("playlist.mp4", b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n", "a playlist of another machine")
    yield Crafted("list.mp4", b"ffconcat version 1.0\nfile /etc/passwd\n", "a list of other files")
    yield Crafted("photograph.mp4", small, "a photograph")
    yield Crafted("noise.mp4", np.random.default_rng(1).bytes(100_000), "noise")
    yield Crafted("empty.mp4", b"", "nothing")


def avi(
    frames: Sequence[bytes],
    width: int,
    height: int,
    codec: bytes = b"MJPG",
    *,
    rate: int = 25,
    scale: int = 1,
    count: int | None = None,
) -> bytes:
    """A container of `frames` that says this size, rate and count."""
    count = len(frames) if count is None else count
    main = struct.pack("<14I", 40_000, 0, 0, 0x10, count, 0, 1, 0, width, height, 0, 0, 0, 0)
    stream = struct.pack("<IHHIIIIIIiI4H", 0, 0, 0, 0, scale, rate, 0, count, 0, -1, 0, 0, 0, 64, 48)
    picture = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, codec, 0, 0, 0, 0, 0)
    tracks = _list(b"strl", _chunk(b"strh", b"vids" + codec + stream) + _chunk(b"strf", picture))
    body = _list(b"hdrl", _chunk(b"avih", main) + tracks)
    body += _list(b"movi", b"".join(_chunk(b"00dc", frame) for frame in frames))
    return _chunk(b"RIFF", b"AVI " + body)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return kind + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)


def _list(kind: bytes, data: bytes) -> bytes:
    return _chunk(b"LIST", kind + data)
