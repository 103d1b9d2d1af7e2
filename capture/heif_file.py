"""Bytes of a HEIC or AVIF file -> upright RGB image and its EXIF, or the reason why not.

Their decoders have had many faults that a crafted file uses. So each file is decoded in a process of its own, which has
a limit on its memory and its time, and which may end.
"""

from __future__ import annotations

import importlib.util
import struct
import subprocess
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from splatnode.capture.image_header import MAX_SIDE, UnusableImage
from splatnode.capture.pi_heif import HEADER
from splatnode.capture.process import apart, python
from splatnode.capture.process.system import remedy

SUFFIXES = {".heic", ".heif", ".hif", ".avif"}
_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"mif1", b"mif2", b"miaf", b"avif"}  # of still images
_MOST_EXIF = 10_000_000  # bytes
_MOST_BOXES = 1000  # at the top level of a file


class HeifImage(NamedTuple):
    image: npt.NDArray[np.uint8]  # (H, W, 3) RGB, upright
    exif: bytes  # a TIFF structure; empty where there is none


def is_heif(data: bytes) -> bool:
    """Whether the bytes begin as a HEIC or AVIF file does (ISO/IEC 23008-12): its first box names one of the brands."""
    if data[4:8] != b"ftyp":
        return False
    first = data[8 : min(int.from_bytes(data[:4], "big"), 1024)]
    return first[:4] in _BRANDS or any(first[i : i + 4] in _BRANDS for i in range(8, len(first), 4))


def installation_advice() -> str | None:
    """Says what to install before such a file can be decoded; None where nothing is missing."""
    there = all(importlib.util.find_spec(package) for package in ("pi_heif", "PIL"))
    return None if there else f"{remedy('pi_heif')}, or convert it to JPEG"


def check_whole(data: bytes) -> None:
    """Raises UnusableImage where the file ends within one of its boxes: somebody may still be writing it."""
    position = 0
    for _ in range(_MOST_BOXES):
        if position == len(data):
            return
        try:
            length, _kind = struct.unpack_from(">I4s", data, position)
            if length == 1:
                (length,) = struct.unpack_from(">Q", data, position + 8)
        except struct.error:
            break
        if length == 0:  # up to the end of the file, wherever that is
            return
        if length < 8 or position + length > len(data):
            break
        position += length
    raise UnusableImage("truncated: the file ends early")


def decode(data: bytes, max_pixels: int) -> HeifImage:
    """The file's primary image, 8 bits a channel, without alpha. Raises UnusableImage."""
    if (needed := installation_advice()) is not None:
        raise UnusableImage(f"HEIC and AVIF need a further package. {needed}")
    check_whole(data)
    command = python.command("splatnode.capture.pi_heif", str(max_pixels))
    with apart.start_process(command, subprocess.PIPE) as child:
        return _receive_image(child, data, max_pixels)


def _receive_image(child: subprocess.Popen[bytes], data: bytes, max_pixels: int) -> HeifImage:
    assert child.stdin is not None and child.stdout is not None
    try:
        child.stdin.write(data)  # it reads all before it writes anything
        child.stdin.close()
    except BrokenPipeError:
        raise UnusableImage("its decoder ended before it had read the file") from None
    head = child.stdout.read(HEADER.size)
    if len(head) < HEADER.size:
        raise UnusableImage(f"damaged, or of an unknown kind: its decoder ended ({child.wait()})")
    width, height, exif_bytes = HEADER.unpack(head)
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        raise UnusableImage(f"{width} x {height}: each side must have 1 to {MAX_SIDE} pixels; resize or cut it")
    if width * height > max_pixels:
        raise UnusableImage(f"{width} x {height}: more than {max_pixels} pixels; make it smaller")
    if exif_bytes > _MOST_EXIF:
        raise UnusableImage(f"damaged: its EXIF has {exif_bytes} bytes; at most {_MOST_EXIF} are read")
    exif, pixels = child.stdout.read(exif_bytes), child.stdout.read(width * height * 3)
    if len(pixels) < width * height * 3:
        raise UnusableImage(f"damaged: its decoder ended ({child.wait()}) within the pixels")
    return HeifImage(np.frombuffer(pixels, np.uint8).reshape(height, width, 3), exif.removeprefix(b"Exif\0\0"))
