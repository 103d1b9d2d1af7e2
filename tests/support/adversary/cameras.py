"""Files of true cameras: nerfstudio's, those of recorded data sets, and COLMAP's as text and as binary."""

from __future__ import annotations

import random
import struct

from tests.support.adversary import edges

_IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
_COUNTS = (1, 2, 0, 2**31, 2**60, 2**64 - 1)


def transforms(rng: random.Random) -> dict[str, object]:
    frames = [
        {"file_path": f"images/view_{i}.png", "transform_matrix": _IDENTITY} for i in range(rng.choice((0, 1, 2)))
    ]
    return {"w": 16, "h": 12, "fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0, "k1": 0.0, "frames": frames}


def recorded(rng: random.Random) -> dict[str, object]:
    K = [[20.0, 0.0, 8.0], [0.0, 20.0, 6.0], [0.0, 0.0, 1.0]]
    rotation = [row[:3] for row in _IDENTITY[:3]]
    entry = {"name": "view_0.png", "R": rotation, "t": [0.0, 0.0, 1.0], "K": K, "width": 16, "height": 12}
    return {"images": [dict(entry, name=f"view_{i}.png") for i in range(rng.choice((0, 1, 2)))]}


def colmap_text(rng: random.Random) -> dict[str, bytes]:
    """The three files of a model, by name."""
    files = {
        "cameras.txt": "# cameras\n1 PINHOLE 16 12 20.0 20.0 8.0 6.0\n",
        "images.txt": "1 1.0 0.0 0.0 0.0 0.0 0.0 0.0 1 view_0.png\n1.0 2.0 1 3.0 4.0 -1\n",
        "points3D.txt": "1 0.0 0.0 1.0 255 0 0 0.5 1 0\n",
    }
    name = rng.choice(list(files))
    for _ in range(rng.choice((0, 1, 2))):
        tokens = files[name].split(" ")
        at = rng.randrange(len(tokens))
        tokens[at] = rng.choice(
            (str(edges.integer(rng)), str(edges.number(rng)), edges.text(rng), "SIMPLE_PINHOLE", "OPENCV")
        )
        if rng.random() < 0.2:
            del tokens[at]
        files[name] = " ".join(tokens)
    if rng.random() < 0.05:
        del files[name]
    return {name: text.encode("utf-8", "surrogatepass") for name, text in files.items()}


def colmap_binary(rng: random.Random) -> dict[str, bytes]:
    """The three files of a model; one of their counts, ids and sizes may be anything."""
    odd = rng.randrange(12)

    def count(at: int, bits: int = 64) -> int:
        return rng.choice(_COUNTS) % 2**bits if odd == at else 1

    camera = struct.pack("<IiQQ", 1, rng.choice((1, 0, 4, -1, 99)) if odd == 3 else 1, *_size(rng, odd == 4))
    lens = struct.pack("<4d", *(edges.number(rng) if odd == 5 else 20.0 for _ in range(4)))
    pose = struct.pack(
        "<I7dI", 1, *(edges.number(rng) if odd == 6 else v for v in (1.0, 0, 0, 0, 0, 0, 0)), count(7, 32)
    )
    image = (
        pose
        + b"view_0.png"
        + (b"\0" if odd != 8 else b"")
        + struct.pack("<Q", count(9))
        + struct.pack("<ddq", 1.0, 2.0, 1)
    )
    point = (
        struct.pack("<Q3d3Bd", 1, 0.0, 0.0, 1.0, 255, 0, 0, 0.5)
        + struct.pack("<Q", count(10))
        + struct.pack("<II", 1, 0)
    )
    files = {
        "cameras.bin": struct.pack("<Q", count(0)) + camera + lens,
        "images.bin": struct.pack("<Q", count(1)) + image,
        "points3D.bin": struct.pack("<Q", count(2)) + point,
    }
    if odd == 11:
        name = rng.choice(list(files))
        files[name] = edges.damaged(rng, files[name], 1)
    return files


def _size(rng: random.Random, odd: bool) -> tuple[int, int]:
    return (edges.unsigned(rng, 64), edges.unsigned(rng, 64)) if odd else (16, 12)
