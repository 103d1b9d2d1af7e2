"""True cameras: cameras.json, transforms.json and COLMAP models that promise what is not there."""

from __future__ import annotations

from collections.abc import Iterator

from tests.support.crafted.crafted import Crafted


def truth_files() -> Iterator[Crafted]:
    """The name is CASE/PATH: where the file lies in the scene's folder. COLMAP's other files are `colmap_model`'s."""
    for file in ("cameras.json", "transforms.json"):
        yield Crafted(f"deep/{file}", b'{"frames":' + b"[" * 100_000, "nested deeper than a parser may recurse")
