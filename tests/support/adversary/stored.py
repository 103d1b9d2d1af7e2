"""What lies in folders that a process takes over: messages on disk, stray files, keys, recordings."""

from __future__ import annotations

import hashlib
import json
import random
import struct
import zlib
from pathlib import Path
from typing import Any

from tests.support.adversary import edges, images
from tests.support.adversary.messages import Parts

_HEAD = struct.Struct("<8sIQI")
_NAMES = (
    "000000000000-0123456789abcdef0123456789abcdef-0.frame",
    "copy of 000000000000-0123456789abcdef0123456789abcdef-5.frame",
    "000000000001-0123456789abcdef0123456789abcdef-1.frame",
    "-.frame",
    "a-b-c.frame",
    "9" * 200 + ".frame",
    "000000000007.frame",
    "١.frame",
    "000000000003.damaged",
    ".x.tmp",
    ".000000000003.frame.1.tmp",
    "lock",
    "ledger",
    "graph",
    "scene",
    "notes.txt",
)
Files = dict[str, bytes | None]  # by name; None: a folder


def message_file(rng: random.Random, parts: Parts) -> bytes:
    """A message on disk, with counts and sizes that may not be its own, and often a checksum that fits all the same."""
    body = b"".join(
        struct.pack("<Q", len(part) if rng.random() < 0.95 else edges.unsigned(rng, 64)) + part for part in parts
    )
    if rng.random() < 0.1:
        body = edges.damaged(rng, body, 1)
    count = len(parts) if rng.random() < 0.9 else edges.unsigned(rng, 32)
    size = len(body) if rng.random() < 0.95 else edges.unsigned(rng, 64)
    checksum = zlib.crc32(body) if rng.random() < 0.95 else 0
    data = _HEAD.pack(b"SPLSPOOL", count, size, checksum) + body
    return data if rng.random() < 0.95 else data[: rng.randrange(len(data) + 1)]


def state_folder(rng: random.Random, data: list[bytes]) -> Files:
    """A folder with these files under names that fit or do not, and strays among them."""
    names = rng.sample(_NAMES, k=rng.choice((1, 2, 4)))
    return {name: rng.choice((*data, b"", None)) for name in names}


def keys(rng: random.Random) -> Files:
    """A folder of keys."""
    good = b"rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7\n"
    odd = (b"", b"\n", good[:-2], good * 2, bytes(40), b"\xff" * 40, b"x" * 5000, None)
    names = ("secret.key", "public.key", "server.key")
    return {name: good if rng.random() < 0.7 else rng.choice(odd) for name in names if rng.random() < 0.9}


def recording(rng: random.Random) -> Files:
    """A recording whose lines may say anything."""
    data = images.image(rng)
    files: Files = {"000000.png": data}
    lines: list[Any] = []
    for index in range(rng.choice((1, 1, 2))):
        lens: Any = {
            "width": 16,
            "height": 12,
            "fx": 20.0,
            "fy": 20.0,
            "cx": 8.0,
            "cy": 6.0,
            "source": "given",
            "distortion": [0.1],
        }
        line = {"type": "frame", "name": f"a{index}.png", "stamp_ns": index, "intrinsics": rng.choice((None, lens))}
        line |= {"captured_at": rng.choice((None, {"ns": index, "clock": "utc"}))}
        line |= {"file": "000000.png", "sha256": hashlib.sha256(data).hexdigest()}
        dropped = {"type": "dropped", "name": "b.png", "reason": "blurred"}
        lines.append(edges.mangled(rng, rng.choice((line, line, dropped)), rng.choice((0, 1, 2))))
    text = "\n".join(json.dumps(line, default=lambda value: value.hex()) for line in lines) + "\n"
    return files | {"splatnode-frames.jsonl": text.encode("utf-8", "surrogatepass")}


def lay(files: Files, folder: Path) -> None:
    """Writes the files into a folder that is empty; names that this file system does not take are left out."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name, data in files.items():
        path = folder / name
        try:
            if data is None:
                path.mkdir(mode=0o700)
            else:
                path.write_bytes(data)
                path.chmod(0o600)
        except (OSError, ValueError):
            continue
