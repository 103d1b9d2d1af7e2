"""Indices of recordings whose lines say what no recorder writes."""

from __future__ import annotations

import json
from collections.abc import Iterator

from tests.support.crafted.crafted import Crafted

FRAME = {"type": "frame", "name": "a", "stamp_ns": 1, "intrinsics": None, "file": "a.png", "sha256": "0" * 64}
LENS = {"width": 4, "height": 4, "fx": 1.0, "fy": 1.0, "cx": 2.0, "cy": 2.0, "source": "given", "distortion": []}


def recordings() -> Iterator[Crafted]:
    """Each is an index; the image a.png may be there."""
    yield Crafted("deep", b'{"type":"frame","x":' + b"[" * 100_000 + b"\n", "nested deeper than a parser may recurse")
    yield Crafted("zeros", bytes(1000) + b"\n", "bytes that are no text")
    yield Crafted("empty", b"", "no line")
    yield Crafted("unfinished", json.dumps(FRAME).encode(), "one line without its end")
    for name, changed in {
        "stamp": {"stamp_ns": 2**80},
        "stamp_late": {"stamp_ns": 2**63 - 1},
        "stamp_early": {"stamp_ns": -1},
        "stamp_text": {"stamp_ns": "1"},
        "captured_late": {"captured_at": {"ns": 2**80, "clock": "utc"}},
        "captured_early": {"captured_at": {"ns": -1, "clock": "utc"}},
        "captured_by": {"captured_at": {"ns": 1, "clock": "sundial"}},
        "path": {"file": "../a.png"},
        "root": {"file": "/dev/zero"},
        "parent": {"file": ".."},
        "null_byte": {"file": "a\0.png"},
        "half_letter": {"file": "\udc80\ud800"},
        "escape": {"name": "\x1b[2J"},
        "long": {"name": "x" * 1_000_000},
        "focal": {"intrinsics": LENS | {"fx": 0.0}},
        "lens": {"intrinsics": LENS | {"distortion": [1e300] * 14}},
        "sides": {"intrinsics": LENS | {"width": 2**62}},
        "further": {"more": 1},
        "kind": {"type": "other"},
    }.items():
        yield Crafted(name, json.dumps(FRAME | changed).encode() + b"\n", str(changed)[:60])
    for name, text in (("1e400", "1e400"), ("nan", "NaN")):
        line = json.dumps(FRAME | {"intrinsics": LENS}).replace('"fx": 1.0', f'"fx": {text}')
        yield Crafted(name, line.encode() + b"\n", f"the number {text}")
