"""docs/api.md says what the code says, of every name of `import splatnode`."""

from __future__ import annotations

import re

import splatnode
from tests.conftest import ROOT
from tests.reference.interface import page, told


def test_the_page_is_up_to_date():
    written = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    assert written == page(), "docs/api.md is not what the code says; run: python -m tests.reference"


def test_every_name_is_told():
    assert told() == set(splatnode.__all__)


def test_every_field_property_and_method_is_described():
    text = page()
    assert not re.findall(r"^\|.*\|\s+\|$", text, re.MULTILINE)
    assert len(re.findall(r"^### ", text, re.MULTILINE)) >= 9 and "None\n\n#" not in text
    assert "| `verdict` | `Verdict` | Whether there is a scene" in text


def test_how_a_function_is_called_is_told():
    assert "    budget_s: float | None = None,\n" in page()
    assert "\n```python\nload(folder: str | PathLike[str]) -> Result\n```\n" in page()
    assert "Session(\n    *,\n    intrinsics" in page()
