"""Scene files (.ply, .spz, .splat) and cameras.json that claim more than they hold, or hold what no scene has."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from tests.support.crafted.crafted import Crafted

NEEDED = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
NEEDED += ["rot_0", "rot_1", "rot_2", "rot_3"]


def scene_files() -> Iterator[Crafted]:
    yield from _plys()
    yield from _spzs()
    for name, row in {
        "nan": [np.nan] * 6,
        "infinite": [0, 0, 0, np.inf, 1, 1],
        "negative": [0, 0, 0, -1, 1, 1],
        "tiny": [1e-45] * 6,
        "far": [3e38, -3e38, 0, 1, 1, 1],
        "wide": [0, 0, 0, 3e38, 3e38, 3e38],
    }.items():
        row_bytes = np.array(row, "<f4").tobytes() + b"\xff\0\0\xff\xff\x80\x80\x80"
        yield Crafted(f"{name}.splat", row_bytes * 3, f"Gaussians with {name} numbers")
    yield Crafted(
        "still.splat", struct.pack("<6f", 0, 0, 0, 1, 1, 1) + bytes([0, 0, 0, 0, 128, 128, 128, 128]), "no rotation"
    )
    yield Crafted("odd.splat", bytes(33), "a part of a Gaussian")
    yield Crafted("empty.splat", b"", "nothing")
    yield Crafted("scene.obj", b"v 0 0 0\n", "a suffix that is none of a scene")


def _plys() -> Iterator[Crafted]:
    for name, count in {
        "long_count": "9" * 5000,
        "zeros_count": "0" * 5000 + "1",
        "huge_count": "9999999999",
        "count_2_63": str(2**63),
        "negative_count": "-1",
        "word_count": "many",
        "no_gaussian": "0",
    }.items():
        yield Crafted(f"{name}.ply", ply(NEEDED, count), "a count of Gaussians that are not there")
    rests = [f"f_rest_{i}" for i in range(45)]
    for name, fields in {
        "gap": [*NEEDED, *(field for field in rests if field != "f_rest_3"), "f_rest_45"],
        "padded": [*NEEDED, *(f"f_rest_{i:02d}" for i in range(9))],
        "named": [*NEEDED, *(f"f_rest_x{i}" for i in range(9))],
        "few_rests": [*NEEDED, *rests[:7]],
        "twice": [*NEEDED, "x"],
        "nothing": [],
        "many": [*NEEDED, *(f"p{i}" for i in range(4000))],
    }.items():
        yield Crafted(f"{name}.ply", ply(fields, "2") + bytes(4 * 2 * len(fields)), "properties that no scene has")
    yield Crafted("list.ply", ply(NEEDED, "1").replace(b"float x", b"list uchar float x"), "a list in each Gaussian")
    yield Crafted("faces_first.ply", ply([], "1").replace(b"vertex", b"face"), "another element first")
    yield Crafted(
        "text.ply", ply(NEEDED, "1").replace(b"binary_little_endian", b"ascii") + b"0 " * 14, "numbers as text"
    )
    yield Crafted("letters.ply", ply(["x\xff", *NEEDED], "1") + bytes(64), "a property whose name is no ASCII")
    yield Crafted("endless.ply", ply(NEEDED, "1")[:-11] + b"comment\n" * 20_000, "a header without an end")
    for name, value in (("nan", np.nan), ("infinite", np.inf), ("large", 3e38), ("subnormal", 1e-45)):
        rows = np.full((3, len(NEEDED)), value, "<f4").tobytes()
        yield Crafted(f"{name}.ply", ply(NEEDED, "3") + rows, f"Gaussians of {name} numbers")
    doubles = np.full((3, len(NEEDED)), 1e300).tobytes()
    yield Crafted("doubles.ply", ply(NEEDED, "3", "double") + doubles, "numbers that no float32 holds")


def ply(fields: list[str], count: str, kind: str = "float") -> bytes:
    """The header of a PLY file with these properties."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property {kind} {field}" for field in fields), "end_header", ""]).encode("latin-1")


def _spzs() -> Iterator[Crafted]:
    for degree, width in ((0, 19), (3, 64)):
        whole = spz(1_000_000, width * 1_000_000, degree)
        yield Crafted(f"bomb_{degree}.spz", whole, "a million Gaussians, all zero, in some kilobytes")
    yield Crafted("count.spz", spz(2**32 - 1, 0), "4 billion Gaussians that are not there")
    yield Crafted("long.spz", spz(1, 200_000_000), "200 MB behind one Gaussian")
    yield Crafted("extensions.spz", spz(1, 200_000_000, flags=2), "200 MB of extensions behind one Gaussian")
    yield Crafted("short.spz", spz(1000, 19), "one Gaussian of a thousand")
    yield Crafted("bits.spz", spz(1, 19, bits=255), "255 fractional bits")
    yield Crafted("degree.spz", spz(1, 19, degree=255), "spherical harmonics of degree 255")
    yield Crafted("version.spz", spz(1, 19, version=2**32 - 1), "a version of the far future")
    yield Crafted("none.spz", spz(0, 0), "no Gaussian")
    yield Crafted("head.spz", spz(1, 19)[:12], "the beginning of a gzip stream")
    yield Crafted("not_zlib.spz", b"\x1f\x8b" + b"\xff" * 100, "no gzip stream behind its signature")


def spz(count: int, body: int, degree: int = 0, version: int = 2, bits: int = 12, flags: int = 0) -> bytes:
    """A .spz file with `body` zeros behind its header."""
    compressor = zlib.compressobj(6, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    header = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, bits, flags, 0)
    parts = [compressor.compress(header)]
    parts += [compressor.compress(bytes(min(1 << 24, body - done))) for done in range(0, body, 1 << 24)]
    return b"".join([*parts, compressor.flush()])


CAMERA = {
    "name": "a.jpg",
    "frame_id": 0,
    "T_world_camera": np.eye(4).tolist(),
    "K": [[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]],
    "width": 100,
    "height": 80,
}


def camera_files() -> Iterator[Crafted]:
    """Each is a cameras.json that is refused."""
    yield Crafted("deep.json", b'{"cameras":' + b"[" * 100_000, "nested deeper than a parser may recurse")
    yield Crafted("deep_remark.json", b'{"x":' + b'{"x":' * 100_000, "the same where nobody looks")
    yield Crafted("wide.json", b'{"cameras":[' + b"[]," * 10_000_000 + b"[]]}", "10 million lists in 30 MB")
    yield Crafted(
        "many.json", json.dumps({"cameras": [CAMERA | {"name": f"{n}"} for n in range(10_001)]}).encode(), "many"
    )
    yield Crafted("too_long.json", b" " * 60_000_000, "more bytes than are read")
    yield Crafted("not_text.json", b"\xff\xfe\x00", "bytes that are no text")
    yield Crafted("zero_bytes.json", bytes(100), "zeros")
    for name, changed in {
        "negative_height": {"height": -1},
        "no_width": {"width": 0},
        "huge_width": {"width": 2**62},
        "half_width": {"width": 1.5},
        "frame_id": {"frame_id": 2**62},
        "singular": {"T_world_camera": np.zeros((4, 4)).tolist()},
        "mirrored": {"T_world_camera": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()},
        "stretched": {"T_world_camera": np.diag([2.0, 2.0, 2.0, 1.0]).tolist()},
        "projective": {"T_world_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]},
        "far": {"T_world_camera": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        "rows": {"T_world_camera": [[1, 0, 0, 0]] * 5},
        "ragged": {"T_world_camera": [[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        "text": {"T_world_camera": "x"},
        "flat": {"T_world_camera": np.eye(4).ravel().tolist()},
        "no_focal": {"K": np.diag([0.0, 0.0, 1.0]).tolist()},
        "turned_focal": {"K": np.diag([-1.0, 1.0, 1.0]).tolist()},
        "large_focal": {"K": np.diag([1e300, 1.0, 1.0]).tolist()},
        "name_list": {"name": ["a"]},
        "name_path": {"name": "../../../etc/passwd"},
        "name_root": {"name": "/dev/zero"},
        "name_escape": {"name": "\x1b[2J"},
        "name_turned": {"name": "a\u202egpj.exe"},
        "name_half": {"name": "\udcff"},
        "name_long": {"name": "x" * 10_000_000},
        "name_empty": {"name": ""},
        "bounds_text": {"bounds": "x"},
        "bounds_empty": {"bounds": {}},
        "bounds_further": {"bounds": {"rotation_deg": 1}},
    }.items():
        yield Crafted(f"{name}.json", json.dumps({"cameras": [CAMERA | changed]}).encode(), str(changed)[:60])
    for name, text in (("1e400", "1e400"), ("nan", "NaN"), ("infinity", "Infinity"), ("long_number", "9" * 5000)):
        content = json.dumps({"cameras": [CAMERA]}).replace("50.0", text)
        yield Crafted(f"{name}.json", content.encode(), f"the number {text[:20]}")
    for name, value in {
        "list": [CAMERA],
        "empty": {},
        "cameras_none": {"cameras": None},
        "cameras_number": {"cameras": 3},
        "camera_number": {"cameras": [3]},
        "two_of_a_name": {"cameras": [CAMERA, CAMERA | {"frame_id": 1}]},
        "scale_list": {"cameras": [CAMERA], "scale_source": [1]},
        "scale_escape": {"cameras": [CAMERA], "scale_source": "\x1b[2J"},
        "scale_lines": {"cameras": [CAMERA], "scale": "metric", "scale_source": "a\n# scale: metric"},
    }.items():
        yield Crafted(f"{name}.json", json.dumps(value).encode(), name.replace("_", " "))
