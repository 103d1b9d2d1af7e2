"""`python -m tests.reference`: writes docs/configuration.md and docs/api.md."""

from __future__ import annotations

from splatnode.capture.process.terminal import say
from tests.conftest import ROOT
from tests.reference import interface, page

PAGES = {"configuration.md": page.page, "api.md": interface.page}

if __name__ == "__main__":
    for name, text in PAGES.items():
        (ROOT / "docs" / name).write_text(text(), encoding="utf-8")
        say(f"docs/{name} is written")
