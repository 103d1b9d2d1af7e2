"""`python -m tests.reference`: writes docs/configuration.md."""

from __future__ import annotations

from splatnode.capture.process.terminal import say
from tests.conftest import ROOT
from tests.reference.page import page

if __name__ == "__main__":
    (ROOT / "docs" / "configuration.md").write_text(page(), encoding="utf-8")
    say("docs/configuration.md is written")
