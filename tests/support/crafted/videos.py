"""Videos whose frames are larger than a camera's, or change their size."""

from __future__ import annotations

from collections.abc import Iterator

from tests.support.crafted.crafted import Crafted


def videos() -> Iterator[Crafted]:
    yield Crafted("empty.mp4", b"", "nothing")
