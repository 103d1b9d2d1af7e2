"""Images that state two sizes, or take far more memory or time than their bytes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from tests.support.crafted.crafted import Crafted

HUGE = 50_000  # pixels a side: 7.5 GB as RGB
SIDE = 16  # of the image that is really there
_RGB = np.full((SIDE, SIDE, 3), 100, np.uint8)


def images() -> Iterator[Crafted]:
    """Every one is a few hundred bytes, or as many kilobytes where the trick needs them."""
    for kind in (_jpegs, _pngs, _webps, _tiffs, _packed_tiffs, _bmps, _runs):
        yield from kind()
    yield Crafted("signature_only.jpg", b"\xff\xd8\xff", "nothing behind the signature")
    yield Crafted("empty.png", b"", "no bytes at all")
    yield Crafted("other.png", b"GIF89a" + struct.pack("<HH", HUGE, HUGE), "a format that OpenCV reads and we do not")


def _jpegs() -> Iterator[Crafted]:
    small = jpeg(SIDE, SIDE)
    huge = jpeg(HUGE, HUGE)[:-2]  # without its end
    frame = next(part for part in _segments(small) if part[1] == 0xC0)
    hidden = struct.pack(">H", len(huge) - 2) + huge[2:]
    yield Crafted("huge.jpg", huge + small[-2:], "a size that the bytes do not hold")
    yield Crafted("second_frame.jpg", huge + small[2:], "a second start of frame, behind the scan of the first")
    yield Crafted("second_frame_alone.jpg", huge + frame + small[-2:], "the same, with nothing behind it")
    for marker in (0x01, 0x02, 0xD8, 0xDC, 0xDE, 0xDF, 0xF0, 0xFD):
        data = b"\xff\xd8\xff" + bytes([marker]) + hidden + small[2:]
        yield Crafted(f"marker_{marker:02x}.jpg", data, "a marker that libjpeg takes for one without a length")
    yield Crafted("zero_length.jpg", small[:2] + b"\xff\xfe\0\0" + small[2:], "a segment shorter than its own length")
    yield Crafted(
        "fill_bytes.jpg", small[:-2] + b"\xff" * 1_000_000 + b"\0" + small[-2:], "a million fill bytes, then 0"
    )
    yield Crafted("no_rows.jpg", jpeg(SIDE, 0), "a height of 0, which would follow after the scan")
    scan = b"\xff\xda\0\x0c\x03\x01\0\x02\0\x03\0\0\x3f\0"
    yield Crafted(
        "scans.jpg", small[:-2] + scan * 10_000 + small[-2:], "a scan costs 14 bytes and a pass over the image"
    )
    profile = b"\xff\xe2\xff\xff" + b"ICC_PROFILE\0\1\xff".ljust(65_533, b"x")
    yield Crafted("profiles.jpg", small[:2] + profile * 255 + small[2:], "17 MB of a colour profile")
    yield Crafted("texts.jpg", small[:2] + (b"\xff\xfe\xff\xff" + bytes(65_533)) * 255 + small[2:], "17 MB of remarks")
    yield Crafted("lossless_frame.jpg", small.replace(b"\xff\xc0", b"\xff\xc3"), "another coding process than it is")
    exif = b"Exif\0\0" + tiff([(274, 4, [6]), (34665, 4, [8])])
    app = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    yield Crafted("exif_loop.jpg", small[:2] + app + small[2:], "an EXIF part that is its own parent")
    exif = b"Exif\0\0" + tiff(
        [(274, 3, [8]), (34665, 5, [2**32 - 1, 1]), (0xA002, 5, [1, 0]), (0xA405, 4, [2**32 - 1])]
    )
    app = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    yield Crafted("exif_numbers.jpg", small[:2] + app + small[2:], "EXIF numbers at the ends of their types")


def _pngs() -> Iterator[Crafted]:
    small, huge = _ihdr(SIDE, SIDE), _ihdr(HUGE, HUGE)
    pixels = (b"IDAT", zlib.compress((b"\0" + bytes(3 * SIDE)) * SIDE))
    end = (b"IEND", b"")
    text = zlib.compress(bytes(7_900_000), 9)
    bomb = (b"IDAT", zlib.compress(bytes(100_000_000), 9))
    yield Crafted("two_sizes.png", png([small, huge, pixels, end]), "two IHDR, the huge one last")
    yield Crafted("two_sizes_turned.png", png([huge, small, pixels, end]), "two IHDR, the huge one first")
    yield Crafted(
        "text_first.png", png([(b"tEXt", small[1][:8] + b"\0"), huge, pixels, end]), "IHDR is not the first chunk"
    )
    yield Crafted(
        "texts.png", png([small] + [(b"zTXt", b"k\0\0" + text)] * 50 + [pixels, end]), "50 texts of 8 MB in 8 KB"
    )
    yield Crafted("profile.png", png([small, (b"iCCP", b"k\0\0" + text), pixels, end]), "a compressed profile")
    yield Crafted("more_pixels.png", png([small, bomb, end]), "100 MB of pixels for an image of 16 x 16")
    yield Crafted("more_data.png", png([small, pixels] + [(b"IDAT", b"")] * 100_000 + [end]), "100 000 empty chunks")
    yield Crafted("long_chunk.png", png([small])[:-4] + b"\xff\xff\xff\xffIDAT", "a chunk of 4 GB")
    long_end = png([small, pixels]) + b"\xff\0\0\0IEND\xae\x42\x60\x82"
    yield Crafted("long_end.png", long_end, "an end of 4 GB, which OpenCV reads for seconds")
    yield Crafted("no_pixels.png", png([small, end]), "no pixels, which OpenCV looks for behind the end")
    yield Crafted("wide.png", png([_ihdr(2**31 - 1, 1), pixels, end]), "one row of 2^31 - 1 pixels")
    yield Crafted("palette.png", png([_ihdr(SIDE, SIDE, 8, 3), pixels, end]), "a palette image without its palette")
    yield Crafted("interlaced.png", png([_ihdr(HUGE, HUGE, 16, 6, 1), pixels, end]), "interlaced: decoded in one piece")
    control = (b"fcTL", struct.pack(">IIIIIHHBB", 0, HUGE, HUGE, 0, 0, 1, 1, 0, 0))
    animation = [small, (b"acTL", struct.pack(">II", 2**31 - 1, 0)), control, pixels]
    yield Crafted("animation.png", png([*animation, end]), "an animation whose frames are larger than the image")


def _webps() -> Iterator[Crafted]:
    small = cv2.imencode(".webp", _RGB, [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()[12:]
    lossless = cv2.imencode(".webp", _RGB, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()[12:]
    wide = b"VP8L" + struct.pack("<I", 6) + b"\x2f" + struct.pack("<I", 16_382 | 16_382 << 14) + b"\0"
    for name, parts in {
        "canvas_small": [_vp8x(8, 8), small],
        "canvas_huge": [_vp8x(16_383, 16_383), small],
        "canvas_late": [small, _vp8x(16_383, 16_383)],
        "two_canvases": [_vp8x(SIDE, SIDE), _vp8x(16_383, 16_383), small],
        "two_images": [small, lossless],
        "second_image_huge": [lossless, wide],
        "junk_first": [b"JUNK" + struct.pack("<I", 2) + b"ab", wide],
        "image_missing": [_vp8x(SIDE, SIDE)],
        "short_canvas": [b"VP8X" + struct.pack("<I", 2) + b"ab", small],
        "many_chunks": [small, (b"JUNK" + bytes(4)) * 100_000],
        "frame_huge": [_vp8x(SIDE, SIDE, 2), _anim(), _anmf(16_383, 16_383, small)],
        "frames": [_vp8x(SIDE, SIDE, 2), _anim(), _anmf(SIDE, SIDE, small) * 1000],
        "animation_huge": [_vp8x(16_383, 16_383, 2), _anim(), _anmf(SIDE, SIDE, small)],
    }.items():
        body = b"".join(parts)
        riff = b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body
        yield Crafted(f"{name}.webp", riff, "chunks of a WebP that disagree about its size")


def _tiffs() -> Iterator[Crafted]:
    for order, letters in (("<", "II"), (">", "MM")):
        for tags, named in (((256, 257), "size"), ((256,), "width"), ((322, 323), "tile"), ((277,), "samples")):
            first = [(tag, 4, [HUGE]) for tag in tags]
            data = tiff([*first, *_entries(SIDE, SIDE)], order)
            yield Crafted(
                f"doubled_{named}_{letters}.tif", data, "a tag twice: libtiff takes the first, others the last"
            )
    for name, changed in {
        "tile": [(322, 4, [16384]), (323, 4, [8192])],
        "strip": [(278, 4, [5_000_000])],
        "all_rows": [(278, 4, [2**32 - 1])],
        "samples": [(277, 3, [65535])],
        "deep": [(258, 3, [64] * 3)],
        "float": [(258, 3, [32] * 3), (339, 3, [3] * 3)],
        "volume": [(32997, 4, [10_000])],
        "tile_volume": [(32998, 4, [10_000]), (322, 4, [SIDE]), (323, 4, [SIDE])],
        "long8": [(256, 16, [HUGE])],
        "signed": [(256, 9, [-1])],
        "rational": [(256, 5, [HUGE, 1])],
        "widths": [(256, 4, [SIDE, HUGE])],
        "wide": [(256, 4, [2**32 - 1]), (257, 4, [1])],
        "high": [(256, 4, [1]), (257, 4, [99_000_000]), (278, 4, [1])],
        "planes": [(284, 3, [2]), (278, 4, [1])],
        "jpeg": [(259, 3, [7])],
        "fax": [(259, 3, [4]), (258, 3, [1]), (277, 3, [1])],
        "palette": [(262, 3, [3]), (258, 3, [16]), (277, 3, [1])],
    }.items():
        entries = {tag: (tag, kind, values) for tag, kind, values in [*_entries(SIDE, SIDE), *changed]}
        data = tiff([entries[tag] for tag in sorted(entries)], body=jpeg(HUGE, HUGE))
        yield Crafted(f"{name}.tif", data, "a part, a sample or a type that is larger than the image")
    yield Crafted("no_directory.tif", b"II*\0" + struct.pack("<I", 2**32 - 1), "a directory behind the end")
    loop = tiff(_entries(SIDE, SIDE))
    yield Crafted("loop.tif", loop.replace(bytes(4), struct.pack("<I", 8), 1), "a next directory that is the first")


def _packed_tiffs() -> Iterator[Crafted]:
    """Of every compression that libtiff may know, with far more in a part than the image has, or none of it."""
    zeros = zlib.compress(bytes(50_000_000), 9)
    runs = b"\x81\0" * 400_000  # of PackBits: 128 zeros each
    for side in (SIDE, 900):
        for number in (
            2,
            3,
            4,
            5,
            6,
            7,
            8,
            32766,
            32771,
            32773,
            32946,
            34661,
            34676,
            34677,
            34887,
            34925,
            50000,
            50001,
        ):
            body = runs if number == 32773 else zeros
            data = _with_strip(side, body, {259: [number]})
            yield Crafted(f"packed_{number}_{side}.tif", data, "a strip that unpacks to 50 MB")
    for name, changed in {
        "strip_bytes": {279: [2**32 - 1]},
        "strip_place": {273: [2**32 - 1]},
        "strips_missing": {278: [1], 259: [8]},
        "tile_packed": {322: [2048], 323: [2048], 259: [8]},
        "text": {270: [2**31 - 1] * 3},
        "profile": {34675: [0] * 100_000},
        "deep_packed": {258: [16] * 4, 277: [4], 259: [8]},
        "directories_within": {330: [8] * 1000},
    }.items():
        yield Crafted(f"{name}.tif", _with_strip(900, zeros, changed), "a part whose length is a lie")
    page = _with_strip(SIDE, bytes(3 * SIDE * SIDE), {})
    (entries,) = struct.unpack_from("<H", page, 8)
    pages, after = bytearray(page), 10 + 12 * entries
    for _ in range(20_000):
        pages[after : after + 4] = struct.pack("<I", len(pages))
        after = len(pages) + 2
        pages += struct.pack("<H", 0) + bytes(4)
    yield Crafted("pages.tif", bytes(pages), "20 000 pages, of which the first is the image")


def _with_strip(side: int, strip: bytes, changed: dict[int, list[int]]) -> bytes:
    """A TIFF of side x side RGB whose one strip has these bytes; with other values of tags."""
    entries = {tag: values for tag, _, values in _entries(side, side)} | {279: [len(strip)]} | changed
    rows = [(tag, 4, values) for tag, values in sorted(entries.items())]
    start = len(tiff(rows))
    if 273 not in changed:
        rows = [(tag, kind, [start] if tag == 273 else values) for tag, kind, values in rows]
    return tiff(rows, body=strip)


def _runs() -> Iterator[Crafted]:
    """BMP files of runs, which say how often a byte is repeated, and where the next one is."""
    for bits, number in ((8, 1), (4, 2), (24, 1), (8, 3), (8, 4), (32, 2)):
        for name, body in {
            "repeated": b"\xff\x01" * 200_000,
            "moved": b"\0\2\xff\xff" * 200_000,
            "lines": b"\0\0" * 200_000,
            "copied": b"\0\xff" + bytes(100),
            "ended": b"\0\1",
        }.items():
            header = struct.pack("<IiiHHIIiiII", 40, 900, 900, 1, bits, number, len(body), 0, 0, 16, 0)
            start = b"BM" + struct.pack("<IHHI", 2**31 - 1, 0, 0, 14 + len(header) + 64)
            yield Crafted(f"{name}_{bits}_{number}.bmp", start + header + bytes(64) + body, "runs beyond the image")


def _bmps() -> Iterator[Crafted]:
    old = struct.pack("<IHHHH", 12, 40_000, 0, 1, 24)
    for name, header in {
        "old": struct.pack("<IHHHH", 12, SIDE, SIDE, 1, 24),
        "old_huge": struct.pack("<IHHHH", 12, HUGE, HUGE, 1, 24),
        "old_zero": old,
        "turned": struct.pack("<IiiHHIIiiII", 40, SIDE, -SIDE, 1, 24, 0, 0, 0, 0, 0, 0),
        "lowest": struct.pack("<IiiHHIIiiII", 40, SIDE, -(2**31), 1, 24, 0, 0, 0, 0, 0, 0),
        "huge": struct.pack("<IiiHHIIiiII", 40, HUGE, HUGE, 1, 24, 0, 0, 0, 0, 0, 0),
        "runs": struct.pack("<IiiHHIIiiII", 40, 900, 900, 1, 8, 1, 0, 0, 0, 2**31 - 1, 0),
        "short_header": struct.pack("<IHHHH", 16, SIDE, SIDE, 1, 24),
        "long_header": struct.pack("<IiiHHIIiiII", 2**31, SIDE, SIDE, 1, 24, 0, 0, 0, 0, 0, 0),
    }.items():
        start = b"BM" + struct.pack("<IHHI", 2**31 - 1, 0, 0, 14 + len(header))
        yield Crafted(f"{name}.bmp", start + header + bytes(3 * SIDE * SIDE), "a header of another age, or a huge one")


def jpeg(width: int, height: int) -> bytes:
    """A JPEG of SIDE x SIDE whose header says something else."""
    parts = _segments(cv2.imencode(".jpg", _RGB)[1].tobytes())
    size = struct.pack(">HH", height, width)
    return b"".join(part[:5] + size + part[9:] if part[:2] == b"\xff\xc0" else part for part in parts)


def _segments(data: bytes) -> list[bytes]:
    """A JPEG's segments with their markers; the scan with all that follows is the last."""
    parts, position = [data[:2]], 2
    while data[position + 1] != 0xDA:
        length = struct.unpack_from(">H", data, position + 2)[0] + 2
        parts.append(data[position : position + length])
        position += length
    return [*parts, data[position:]]


def _ihdr(width: int, height: int, depth: int = 8, colour: int = 2, interlace: int = 0) -> tuple[bytes, bytes]:
    return b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlace)


def png(chunks: Sequence[tuple[bytes, bytes]]) -> bytes:
    """A PNG file of these chunks, each with its checksum."""
    packed = (struct.pack(">I", len(d)) + kind + d + struct.pack(">I", zlib.crc32(kind + d)) for kind, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def _vp8x(width: int, height: int, flags: int = 0) -> bytes:
    sides = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"VP8X" + struct.pack("<I", 10) + bytes([flags, 0, 0, 0]) + sides


def _anim() -> bytes:
    return b"ANIM" + struct.pack("<I", 6) + bytes(6)


def _anmf(width: int, height: int, image: bytes) -> bytes:
    sides = bytes(6) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"ANMF" + struct.pack("<I", 16 + len(image)) + sides + b"\x64\0\0\0" + image


def _entries(width: int, height: int) -> list[tuple[int, int, list[int]]]:
    """Tags of an RGB image in one strip, its bytes at the beginning of the file."""
    one = {256: width, 257: height, 258: 8, 259: 1, 262: 2, 273: 8, 277: 3, 278: height, 279: 3 * width * height}
    return [(tag, 4, [value]) for tag, value in one.items()]


def tiff(entries: Sequence[tuple[int, int, list[int]]], order: str = "<", body: bytes = b"") -> bytes:
    """A TIFF file of one directory with the entries (tag, type, values) in the order given."""
    letters = {3: "H", 4: "I", 5: "I", 9: "i", 16: "Q"}
    start = 8 + 2 + 12 * len(entries) + 4
    rows, values = b"", b""
    for tag, kind, numbers in entries:
        packed = struct.pack(f"{order}{len(numbers)}{letters[kind]}", *numbers)
        count = len(numbers) // 2 if kind == 5 else len(numbers)
        rows += struct.pack(order + "HHI", tag, kind, count)
        rows += packed.ljust(4, b"\0") if len(packed) <= 4 else struct.pack(order + "I", start + len(values))
        values += packed if len(packed) > 4 else b""
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "IH", 8, len(entries))
    return head + rows + bytes(4) + values + body
