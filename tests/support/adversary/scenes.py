"""Scene files: PLY, spz and splat, with headers that promise something else than what follows."""

from __future__ import annotations

import gzip
import random
import struct

import numpy as np

from tests.support.adversary import edges

_PROPERTIES = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_TYPES = ("float", "float", "float", "double", "uchar", "int", "short", "list uchar int", "string")
_BOUNDS = {
    **dict.fromkeys(("rotation_deg", "centre", "centre_percent", "focal_percent"), 0.5),
    "axes": np.eye(3).tolist(),
}
_COUNTS = ("0", "1", "2", "7", "-1", "1.0", "9" * 5000, "1e9", "0x10", "١٢", str(2**31), str(2**62), str(2**64))


def ply(rng: random.Random) -> bytes:
    """In a third of the files everything is sound; in the others one or more things of header and body are not."""
    odd = rng.choice((0.0, 0.3, 1.0))
    names = list(_PROPERTIES)
    names += [f"f_rest_{index}" for index in range(rng.choice((0, 0, 9, 24, 45) if rng.random() >= odd else (1, 10)))]
    for _ in range(rng.choice((0, 1, 2)) if rng.random() < odd else 0):
        action = rng.randrange(4)
        at = rng.randrange(len(names))
        if action == 0:
            names.pop(at)
        elif action == 1:
            names.append(names[at])
        elif action == 2:
            names[at] = rng.choice((f"f_rest_{edges.integer(rng)}", edges.text(rng), "nx", ""))
        else:
            rng.shuffle(names)
    usual = rng.random() >= odd
    count = rng.choice((0, 1, 7))
    stated = rng.choice(_COUNTS) if rng.random() < odd / 2 else str(count)
    form = rng.choice(("ascii", "binary_big_endian", "")) if rng.random() < odd / 5 else "binary_little_endian"
    element = rng.choice(("face", edges.text(rng))) if rng.random() < odd / 5 else "vertex"
    lines = ["ply", f"format {form} 1.0", f"element {element} {stated}"]
    lines += [f"property {'float' if usual else rng.choice(_TYPES)} {name}" for name in names]
    if rng.random() < 0.1:
        lines.insert(
            rng.randrange(len(lines) + 1),
            rng.choice(("element face 3", "comment " + edges.text(rng), "\r", "property")),
        )
    lines.append("end_header" if rng.random() >= odd / 20 else "")
    row = b"".join(edges.single(rng) if rng.random() < odd else struct.pack("<f", 0.5) for _ in names)
    body = row * (rng.choice((0, 1, 6)) if rng.random() < odd / 2 else count)
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass") + body


def spz(rng: random.Random) -> bytes:
    count = rng.choice((0, 1, 7, edges.unsigned(rng, 32)))
    degree = rng.choice((0, 1, 2, 3, 4, 255))
    version = rng.choice((2, 2, 3, 3, 1, edges.unsigned(rng, 32)))
    magic = 0x5053474E if rng.random() < 0.97 else edges.unsigned(rng, 32)
    header = struct.pack(
        "<IIIBBBB", magic, version, count, degree, rng.choice((0, 12, 23, 24, 255)), rng.randrange(4), 0
    )
    bases = {0: 0, 1: 3, 2: 8, 3: 15}.get(degree, 15)
    width = 9 + 1 + 3 + 3 + (4 if version == 3 else 3) + 3 * bases
    size = count * width if count < 1000 else rng.choice((0, 1000))
    body = rng.randbytes(max(0, size + rng.choice((0, 0, 0, -1, 1, 5000))))
    data = gzip.compress(header + body, 1, mtime=0)
    return data if rng.random() < 0.9 else edges.damaged(rng, data, 1)


def splat(rng: random.Random) -> bytes:
    count = rng.choice((0, 1, 2, 7))
    rows = b"".join(
        b"".join(edges.single(rng) if rng.random() < 0.2 else struct.pack("<f", 0.5) for _ in range(6))
        + rng.randbytes(8)
        for _ in range(count)
    )
    return rows + bytes(rng.choice((0, 0, 1, 31)))


def cameras(rng: random.Random) -> dict[str, object]:
    """A cameras.json as ours are, sound."""
    return {
        "scale": rng.choice(("relative", "metric")),
        "scale_source": None,
        "axes": "OpenCV: x right, y down, z forward",
        "cameras": [
            {
                "name": f"view_{index}.png",
                "frame_id": index,
                "T_world_camera": np.eye(4).tolist(),
                "K": [[20.0, 0.0, 8.0], [0.0, 20.0, 6.0], [0.0, 0.0, 1.0]],
                "width": 16,
                "height": 12,
                "bounds": rng.choice((None, _BOUNDS)),
                **rng.choice(({}, {"stamp_ns": index, "clock": rng.choice(("utc", "local"))})),
            }
            for index in range(rng.choice((0, 1, 2)))
        ],
    }


def report(rng: random.Random) -> dict[str, object]:
    """What a viewer reads of a report.json."""
    verdict = {"code": "OK", "message": "fine", "advice": "", "frames": [], "publishable": True, "provisional": False}
    return {
        "verdict": verdict,
        "frames_dropped": [{"name": "a.png", "reason": "blurred"}],
        "iterations": 100,
        "seconds": {"total": 1.0},
        "photographs": rng.choice((None, "photographs")),
    }
