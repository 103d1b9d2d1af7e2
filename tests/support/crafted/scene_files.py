"""Scene files (.ply, .spz, .splat) and cameras.json that claim more than they hold, or hold what no scene has."""

from __future__ import annotations

from collections.abc import Iterator

from tests.support.crafted.crafted import Crafted


def scene_files() -> Iterator[Crafted]:
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex "
    yield Crafted("long_count.ply", head + b"9" * 5000 + b"\nend_header\n", "a count of 5000 digits")


def camera_files() -> Iterator[Crafted]:
    """Each is a cameras.json."""
    yield Crafted("deep.json", b'{"cameras":' + b"[" * 100_000, "nested deeper than a parser may recurse")
