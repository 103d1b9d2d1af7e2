"""`python -m tests.reference`: writes docs/configuration.md, docs/api.md and the tables of what was measured."""

from __future__ import annotations

from splatnode.capture.process.terminal import say
from tests.conftest import ROOT
from tests.reference import interface, page
from tests.reference.measured import blocks

PAGES = {"configuration.md": page.page, "api.md": interface.page}

if __name__ == "__main__":
    for name, text in PAGES.items():
        (ROOT / "docs" / name).write_text(text(), encoding="utf-8")
        say(f"docs/{name} is written")
    for path in blocks.find_pages():
        path.write_text(blocks.fill(path.read_text(encoding="utf-8")), encoding="utf-8")
        say(f"the tables of docs/{path.name} are written")
