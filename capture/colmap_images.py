"""The photographs of a COLMAP model: images.txt and images.bin. Their points are passed over."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

from splatnode.capture.process.printable import sanitize_text

_POINT2D_BYTES = 24
_LONGEST_NAME = 4096  # bytes


class ImageRow(NamedTuple):
    name: str
    motion: tuple[float, ...]  # quaternion wxyz and translation of T_camera_world
    camera_id: int


def content_lines(text: str) -> Iterator[str]:
    """The lines of a text file of a model, without its comments."""
    return (line for line in each_line(text) if not line.startswith("#"))


def each_line(text: str) -> Iterator[str]:
    """The lines of a text, one after the other: a list of all, which may be empty ones, takes far more memory."""
    end_of_line = "\n" if "\n" in text else "\r"
    start = 0
    while start < len(text):
        end = text.find(end_of_line, start)
        end = len(text) if end < 0 else end
        yield text[start:end].rstrip("\r")
        start = end + 1


def text_images(text: str) -> Iterator[ImageRow]:
    """Parses images.txt: two lines an image, of which the second, its points, may be empty. Raises ValueError."""
    lines = content_lines(text)
    for line in lines:
        if line.strip():
            _, *motion, camera_id, name = line.split(maxsplit=9)
            yield ImageRow(name.strip(), tuple(map(float, motion)), int(camera_id))
            next(lines, "")


def binary_images(data: bytes) -> Iterator[ImageRow]:
    """Parses images.bin. Raises ValueError, struct.error."""
    (count,), position = struct.unpack_from("<Q", data), 8
    for _ in range(count):  # ends at the latest where the bytes do
        _, *motion, camera_id = struct.unpack_from("<I7dI", data, position)
        end = data.index(b"\0", position + 64, position + 64 + _LONGEST_NAME)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        name, position = data[position + 64 : end].decode(), end + 9 + _POINT2D_BYTES * points
        if position > len(data):
            raise ValueError(f"{sanitize_text(name, 100)} has {points} points, which are not there")
        yield ImageRow(name, tuple(motion), camera_id)
