"""Writes what was measured between the marks of a page: `<!-- table: NAME -->` and `<!-- end -->`."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from tests.conftest import ROOT
from tests.reference.measured import ages, cameras, headline, live, race, robustness, roles, scenes

BLOCKS: dict[str, Callable[[], str]] = {
    block.__name__: block
    for room in (headline, scenes, race, cameras, robustness, live, roles, ages)
    for block in room.BLOCKS
}
BLOCK = re.compile(r"(<!-- table: (\w+) -->\n)(.*?)(^<!-- end -->)", re.DOTALL | re.MULTILINE)


def find_pages() -> list[Path]:
    """Returns README and the pages of docs/ that have a mark."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return [path for path in pages if "<!-- table: " in path.read_text(encoding="utf-8")]


def fill(text: str) -> str:
    """Returns a page with what its marks name. Raises KeyError for a name that there is not."""
    return BLOCK.sub(lambda match: f"{match[1]}\n{BLOCKS[match[2]]()}\n\n{match[4]}", text)


def list_names(text: str) -> list[str]:
    """Returns the names of a page's marks."""
    return re.findall(r"^<!-- table: (\w+) -->$", text, re.MULTILINE)


def cut(text: str) -> str:
    """Returns what people wrote of a page: without what stands between marks."""
    return BLOCK.sub("", text)
