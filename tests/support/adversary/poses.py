"""Files of poses: TUM trajectories, transforms.json, and COLMAP's images, text and binary."""

from __future__ import annotations

import random

from tests.support.adversary import cameras, documents, edges
from tests.support.adversary.stored import Files

_USUAL = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def poses_file(rng: random.Random) -> Files:
    """One file, by a name that tells its kind."""
    kind = rng.randrange(6)
    if kind < 3:
        return {"poses.txt": _tum(rng)}
    if kind == 3:
        return {"transforms.json": documents.json_file(rng, cameras.transforms(rng))}
    files, name = (cameras.colmap_text, "images.txt") if kind == 4 else (cameras.colmap_binary, "images.bin")
    return {name: files(rng).get(name, b"")}


def _tum(rng: random.Random) -> bytes:
    share = rng.choice((0.0, 0.0, 0.02, 0.2))
    lines = []
    for index in range(rng.choice((0, 1, 2, 5))):
        first = rng.choice((str(index), f"{1.7e9 + index}", f"view_{index}.png", f"{rng.random()}"))
        words = [edges.odd(rng, usual, share) for usual in (first, *_USUAL)]
        if rng.random() < share / 4:
            words.pop()
        lines.append(rng.choice((" ", " ", " ", "\t", ",")).join(words) if share else " ".join(words))
    if rng.random() < 0.1:
        lines.insert(0, rng.choice(("# time x y z", "", "\ufeff", "\x1b[2J", "#" * 3000)))
    return ("\n".join(lines) + rng.choice(("\n", "\r\n", ""))).encode("utf-8", "surrogatepass")
