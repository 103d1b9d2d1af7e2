"""Images that state two sizes, or take far more memory than their bytes."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from tests.support.crafted.crafted import Crafted

HUGE = 50_000  # pixels a side: 7.5 GB as RGB


def images() -> Iterator[Crafted]:
    yield from _tiffs()


def _tiffs() -> Iterator[Crafted]:
    for order, letters in (("<", b"II"), (">", b"MM")):
        entries = [(256, HUGE), (256, 8), (257, HUGE), (257, 8), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1)]
        yield Crafted(
            f"doubled_tags_{letters.decode()}.tif",
            tiff(entries, order),
            "ImageWidth and ImageLength stand twice: libtiff takes the first, a reader of all the last",
        )


def tiff(entries: list[tuple[int, int]], order: str = "<") -> bytes:
    """A TIFF file of one directory with a LONG a tag, in the order given."""
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "I", 8)
    rows = b"".join(struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in entries)
    return head + struct.pack(order + "H", len(entries)) + rows + bytes(4)
