"""True cameras: cameras.json, transforms.json and COLMAP models that promise what is not there."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator

import numpy as np

from tests.support.crafted.crafted import Crafted
from tests.support.crafted.scene_files import camera_files

K = [[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]]
PHOTOGRAPH = {"name": "a.jpg", "R": np.eye(3).tolist(), "t": [0, 0, 0], "K": K, "width": 100, "height": 80}
VIEW = {"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist(), "w": 100, "h": 80, "fl_x": 100}
CAMERAS_BIN = struct.pack("<QIiQQ4d", 1, 1, 1, 100, 80, 100, 100, 50, 40)
IMAGES_BIN = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.jpg\0" + bytes(8)
CAMERAS_TXT, IMAGES_TXT = b"# cameras\n1 PINHOLE 100 80 100 100 50 40\n", b"# images\n1 1 0 0 0 0 0 0 1 a.jpg\n\n"
MODEL = {"cameras.bin": CAMERAS_BIN, "images.bin": IMAGES_BIN}
TEXT_MODEL = {"cameras.txt": CAMERAS_TXT, "images.txt": IMAGES_TXT}


def truth_files() -> Iterator[Crafted]:
    """The name is CASE/PATH: where the file lies in the scene's folder. All are refused.

    Of a file in sparse/0, the other files of the model are those of `MODEL` or `TEXT_MODEL`.
    """
    for file in camera_files():
        yield Crafted(f"ours_{file.name.removesuffix('.json')}/cameras.json", file.data, file.trick)
    yield from _recorded()
    yield from _transforms()
    yield from _models()


def _recorded() -> Iterator[Crafted]:
    for name, changed in {
        "singular": {"R": np.zeros((3, 3)).tolist()},
        "mirrored": {"R": np.diag([1, 1, -1]).tolist()},
        "far": {"t": [1e300, 0, 0]},
        "no_translation": {"t": None},
        "no_lens": {"K": None},
        "flat": {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1]},
        "no_height": {"height": 0},
        "huge": {"width": 2**62},
        "half": {"width": 99.5},
        "no_name": {"name": ""},
        "name_list": {"name": [1]},
        "escape": {"name": "\x1b[2J", "width": -1},
    }.items():
        content = json.dumps({"images": [PHOTOGRAPH | changed]})
        yield Crafted(f"recorded_{name}/cameras.json", content.encode(), str(changed))
    twice = json.dumps({"images": [PHOTOGRAPH, PHOTOGRAPH]})
    yield Crafted("recorded_twice/cameras.json", twice.encode(), "two cameras of one name")
    yield Crafted("recorded_number/cameras.json", b'{"images": 3}', "a number in place of a list")


def _transforms() -> Iterator[Crafted]:
    yield Crafted("deep/transforms.json", b'{"frames":' + b"[" * 100_000, "nested deeper than a parser may recurse")
    yield Crafted("wide/transforms.json", b'{"frames":[' + b"[]," * 10_000_000 + b"[]]}", "10 million lists in 30 MB")
    for name, changed in {
        "nothing": {"file_path": None},
        "singular": {"transform_matrix": np.zeros((4, 4)).tolist()},
        "rows": {"transform_matrix": np.eye(4).tolist()[:3]},
        "text": {"transform_matrix": "x"},
        "negative": {"h": -80},
        "huge": {"w": 1e300},
        "no_focal": {"fl_x": 0},
        "focal_text": {"fl_x": "100"},
        "missing": {"fl_x": None},
        "distorted": {"k1": 0.1},
    }.items():
        yield Crafted(f"{name}/transforms.json", json.dumps({"frames": [VIEW | changed]}).encode(), str(changed))
    number = json.dumps({"frames": [VIEW]}).replace('"w": 100', '"w": 1e400')
    yield Crafted("1e400/transforms.json", number.encode(), "the number 1e400")
    folders = [VIEW | {"file_path": "x/a.jpg"}, VIEW | {"file_path": "y/a.jpg"}]
    yield Crafted("twice/transforms.json", json.dumps({"frames": folders}).encode(), "two photographs of one name")


def _models() -> Iterator[Crafted]:
    for name, data in {
        "empty": b"",
        "count": struct.pack("<Q", 2**60),
        "count_most": struct.pack("<Q", 2**64 - 1) + CAMERAS_BIN[8:],
        "short": CAMERAS_BIN[:-1],
        "model": CAMERAS_BIN[:12] + struct.pack("<i", -1) + CAMERAS_BIN[16:],
        "distorted": CAMERAS_BIN[:12] + struct.pack("<i", 4) + CAMERAS_BIN[16:] + bytes(32),
        "huge": CAMERAS_BIN[:16] + struct.pack("<QQ", 2**63, 1) + CAMERAS_BIN[32:],
        "nan": CAMERAS_BIN[:32] + struct.pack("<4d", *[np.nan] * 4),
        "unknown": CAMERAS_BIN[:8] + struct.pack("<I", 7) + CAMERAS_BIN[12:],
    }.items():
        yield Crafted(f"cameras_{name}/sparse/0/cameras.bin", data, f"binary cameras: {name}")
    for name, data in {
        "empty": b"",
        "count": struct.pack("<Q", 2**60) + IMAGES_BIN[8:],
        "short": IMAGES_BIN[:-1],
        "endless_name": IMAGES_BIN[:72] + b"x" * 1_000_000,
        "name": IMAGES_BIN[:72] + b"\xff\0" + bytes(8),
        "points": IMAGES_BIN[:-8] + struct.pack("<Q", 2**60),
        "twice": struct.pack("<Q", 2) + IMAGES_BIN[8:] * 2,
        "turn": IMAGES_BIN[:12] + bytes(32) + IMAGES_BIN[44:],
        "nan": IMAGES_BIN[:12] + struct.pack("<7d", *[np.nan] * 7) + IMAGES_BIN[68:],
        "unknown": IMAGES_BIN[:68] + struct.pack("<I", 7) + IMAGES_BIN[72:],
    }.items():
        data = data + IMAGES_BIN if name == "points" else data
        yield Crafted(f"images_{name}/sparse/0/images.bin", data, f"binary images: {name}")
    for name, text in {
        "words": "1 PINHOLE a b c d e f",
        "few": "1 PINHOLE 100",
        "many": "1 PINHOLE 100 80 " + "1 " * 100_000,
        "model": "1 OPENCV 100 80 100 100 50 40 0 0 0 0",
        "digits": "1 PINHOLE " + "9" * 5000 + " 80 100 100 50 40",
        "nan": "1 PINHOLE 100 80 nan 100 50 40",
        "bytes": "\udcff",
    }.items():
        yield Crafted(
            f"text_{name}/sparse/0/cameras.txt", text.encode(errors="surrogateescape"), f"cameras as text: {name}"
        )
    for name, text in {
        "words": "1 a b c d e f g h a.jpg\n\n",
        "few": "1 2 3\n\n",
        "unknown": "1 1 0 0 0 0 0 0 7 a.jpg\n\n",
        "infinite": "1 1 0 0 0 inf 0 0 1 a.jpg\n\n",
        "zero": "1 0 0 0 0 0 0 0 1 a.jpg\n\n",
        "twice": "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 1 b/a.jpg\n\n",
    }.items():
        yield Crafted(f"text_images_{name}/sparse/0/images.txt", text.encode(), f"images as text: {name}")
