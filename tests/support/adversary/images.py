"""Image files from their grammars: segments, chunks, directories, with edge numbers in the places of sizes."""

from __future__ import annotations

import functools
import random
import struct
import zlib

import cv2
import numpy as np

from tests.support.adversary import edges

_TIFF_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8}
_SOF0, _SOF2, _SOS, _APP1 = 0xC0, 0xC2, 0xDA, 0xE1


def image(rng: random.Random) -> bytes:
    """A file of one of the formats that are read."""
    return rng.choice((jpeg, png, tiff, webp, bmp))(rng)


@functools.lru_cache(maxsize=8)
def sound(suffix: str) -> bytes:
    """A whole file of 16 x 12 pixels."""
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3)).astype(np.uint8)
    return cv2.imencode(suffix, pixels)[1].tobytes()


@functools.lru_cache(maxsize=1)
def deep_png() -> bytes:
    """A whole file of 16 x 12 pixels of 16 bits, as depth has them."""
    return cv2.imencode(".png", np.arange(192, dtype=np.uint16).reshape(12, 16) * 300)[1].tobytes()


@functools.lru_cache(maxsize=8)
def _zeros(size: int) -> bytes:
    return zlib.compress(bytes(size))


def jpeg(rng: random.Random) -> bytes:
    """Segments of a real file, with other sizes, doubled frames, EXIF, in another order, or cut."""
    segments = list(_jpeg_segments())
    for _ in range(rng.choice((0, 1, 1, 2, 4))):
        at = rng.randrange(len(segments))
        action = rng.randrange(7)
        if action == 0:
            segments.insert(at, _start_of_frame(rng))
        elif action == 1:
            segments = [_start_of_frame(rng) if each[1:2] in (b"\xc0", b"\xc2") else each for each in segments]
        elif action == 2:
            segments.insert(at, _segment(_APP1, b"Exif\0\0" + tiff(rng)[:60000]))
        elif action == 3:
            segments[at] = edges.damaged(rng, segments[at], 1)
        elif action == 4:
            segments.append(segments[at])
        elif action == 5:
            segments.insert(at, _segment(rng.randrange(0xC0, 0xFF), rng.randbytes(rng.choice((0, 1, 20)))))
        else:
            segments[-1:] = [_start_of_frame(rng), *segments[-2:]]  # another frame within or after the scan
    data = b"".join(segments)
    return data if rng.random() < 0.9 else data[: rng.randrange(len(data) + 1)]


@functools.lru_cache(maxsize=1)
def _jpeg_segments() -> tuple[bytes, ...]:
    data, segments, position = sound(".jpg"), [b"\xff\xd8"], 2
    while data[position + 1] != _SOS:
        (length,) = struct.unpack_from(">H", data, position + 2)
        segments.append(data[position : position + 2 + length])
        position += 2 + length
    return (*segments, data[position:-2], data[-2:])


def _segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def _start_of_frame(rng: random.Random) -> bytes:
    height, width = edges.unsigned(rng, 16), edges.unsigned(rng, 16)
    body = struct.pack(">BHHB", rng.choice((8, 8, 12, 255)), height, width, 3) + bytes(
        (1, 0x22, 0, 2, 0x11, 0, 3, 0x11, 0)
    )
    return _segment(rng.choice((_SOF0, _SOF2, 0xC1, 0xC9, 0xCF)), body)


def png(rng: random.Random) -> bytes:
    """IHDR with edge sizes, chunks that a file has once twice, and compressed data of any length."""
    width, height = (16, 12) if rng.random() < 0.4 else (edges.unsigned(rng, 32), edges.unsigned(rng, 32))
    depth, colour = rng.choice(((8, 2), (8, 0), (8, 6), (16, 2), (1, 0), (8, 3), (255, 7)))
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, rng.choice((0, 0, 1)))
    pixels = _zeros(rng.choice((0, 100, 12 * 49, 100_000)))
    chunks = [(b"IHDR", header), (b"IDAT", pixels), (b"IEND", b"")]
    for _ in range(rng.choice((0, 0, 1, 2, 3))):
        other = struct.pack(">II", edges.unsigned(rng, 32), edges.unsigned(rng, 32)) + header[8:]
        extra = rng.choice(
            (
                (b"IHDR", other),
                (b"eXIf", tiff(rng)),
                (b"zTXt", b"a\0\0" + _zeros(rng.choice((10, 1_000_000)))),
                (b"iCCP", b"a\0\0" + _zeros(rng.choice((10, 1_000_000)))),
                (b"PLTE", bytes(3 * rng.choice((0, 1, 256, 300)))),
                (b"acTL", struct.pack(">II", edges.unsigned(rng, 32), 0)),
                (b"fcTL", struct.pack(">IIIIIHHBB", 0, *(edges.unsigned(rng, 32) for _ in range(4)), 1, 1, 0, 0)),
                (b"IDAT", rng.randbytes(rng.choice((0, 20)))),
            )
        )
        chunks.insert(rng.randrange(len(chunks) + 1), extra)
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(rng, *each) for each in chunks)


def _chunk(rng: random.Random, kind: bytes, body: bytes) -> bytes:
    length = len(body) if rng.random() < 0.97 else edges.unsigned(rng, 32)
    checksum = zlib.crc32(kind + body) if rng.random() < 0.95 else 0
    return struct.pack(">I4s", length, kind) + body + struct.pack(">I", checksum)


def tiff(rng: random.Random) -> bytes:
    """A directory with any tags, doubled ones among them, with edge counts and values; pixels behind it."""
    order = rng.choice("<>")
    data = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8 if rng.random() < 0.95 else 2**32 - 1)
    width, height = rng.choice(((16, 12), (16, 12), (edges.unsigned(rng, 32), edges.unsigned(rng, 32))))
    entries = [
        _entry(order, 256, 4, 1, width),
        _entry(order, 257, 4, 1, height),
        _entry(order, 258, 3, 1, rng.choice((1, 8, 16, 32, 64))),
        _entry(order, 259, 3, 1, rng.choice((1, 1, 5, 7, 8, 32773, 34712))),
        _entry(order, 262, 3, 1, rng.choice((0, 1, 2, 3, 6))),
        _entry(order, 273, 4, 1, rng.choice((300, edges.unsigned(rng, 32)))),
        _entry(order, 277, 3, 1, rng.choice((1, 3, 4, 255))),
        _entry(order, 278, 4, 1, rng.choice((12, height, edges.unsigned(rng, 32)))),
        _entry(order, 279, 4, 1, rng.choice((576, edges.unsigned(rng, 32)))),
    ]
    for _ in range(rng.choice((0, 1, 2, 4))):
        tag = rng.choice(
            (256, 257, 258, 277, 278, 279, 322, 323, 324, 330, 339, 271, 274, 34665, 37386, 41989, 33434, 33437, 34855)
        )
        kind = rng.choice((*_TIFF_SIZES, 0, 99))
        count = rng.choice((1, 1, edges.unsigned(rng, 32)))
        entries.insert(rng.randrange(len(entries) + 1), _entry(order, tag, kind, count, edges.unsigned(rng, 32)))
    if rng.random() < 0.8:
        entries.sort(key=lambda each: struct.unpack_from(order + "H", each)[0])
    count = len(entries) if rng.random() < 0.95 else edges.unsigned(rng, 16)
    further = rng.choice((0, 0, 8, edges.unsigned(rng, 32)))
    return data + struct.pack(order + "H", count) + b"".join(entries) + struct.pack(order + "I", further) + bytes(700)


def _entry(order: str, tag: int, kind: int, count: int, value: int) -> bytes:
    if kind == 3 and count == 1:
        return struct.pack(order + "HHIHH", tag, kind, count, value % 65536, 0)
    return struct.pack(order + "HHII", tag, kind, count, value)


def webp(rng: random.Random) -> bytes:
    """RIFF chunks of a real file, with an extended header of any size before them, and others doubled."""
    data = sound(".webp")
    chunks, position = [], 12
    while position + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, position)
        chunks.append((kind, data[position + 8 : position + 8 + length]))
        position += 8 + length + length % 2
    for _ in range(rng.choice((0, 1, 2))):
        at = rng.randrange(len(chunks) + 1)
        width, height = edges.unsigned(rng, 24), edges.unsigned(rng, 24)
        bits = (width & 0x3FFF) | (height & 0x3FFF) << 14
        extra = rng.choice(
            (
                (
                    b"VP8X",
                    bytes((rng.randrange(256), 0, 0, 0)) + width.to_bytes(3, "little") + height.to_bytes(3, "little"),
                ),
                (b"VP8L", b"\x2f" + struct.pack("<I", bits) + rng.randbytes(20)),
                (
                    b"VP8 ",
                    b"\x10\x00\x00\x9d\x01\x2a" + struct.pack("<HH", width & 0xFFFF, height & 0xFFFF) + bytes(20),
                ),
                (b"ANMF", rng.randbytes(16)),
                (b"EXIF", tiff(rng)),
            )
        )
        chunks.insert(at, extra)
    body = b"".join(struct.pack("<4sI", k, len(b)) + b + bytes(len(b) % 2) for k, b in chunks)
    length = len(body) + 4 if rng.random() < 0.9 else edges.unsigned(rng, 32)
    result = struct.pack("<4sI4s", b"RIFF", length, b"WEBP") + body
    return result if rng.random() < 0.9 else edges.damaged(rng, result, 1)


def bmp(rng: random.Random) -> bytes:
    """A header of any of its versions with edge sizes, depths and compressions."""
    size = rng.choice((12, 40, 40, 56, 108, 124, edges.unsigned(rng, 32)))
    width, height = (16, 12) if rng.random() < 0.4 else (edges.unsigned(rng, 32), edges.unsigned(rng, 32))
    head = struct.pack("<2sIHHI", b"BM", 54 + 576, 0, 0, rng.choice((54, 26, edges.unsigned(rng, 32))))
    depth = rng.choice((24, 24, 1, 4, 8, 16, 32, edges.unsigned(rng, 16)))
    if size == 12:
        return head + struct.pack("<IHHHH", size, width % 65536, height % 65536, 1, depth) + rng.randbytes(600)
    compression = rng.choice((0, 0, 1, 2, 3, edges.unsigned(rng, 32)))
    body = struct.pack(
        "<IIIHHIIIIII", size, width, height, 1, depth, compression, 576, 0, 0, edges.unsigned(rng, 32), 0
    )
    return head + body + rng.randbytes(rng.choice((0, 600)))
