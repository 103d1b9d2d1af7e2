"""The examples of docs/locate.md run, on a small result, as it is printed."""

from __future__ import annotations

import re
from pathlib import Path

from splatnode.capture.image_file import encode_png
from splatnode.recon.locating import Reason
from splatnode.recon.result.stored_snapshot import LANDMARKS, encode_landmarks
from tests.conftest import ROOT
from tests.support.located import known_place, photograph

PAGE = (ROOT / "docs" / "locate.md").read_text(encoding="utf-8")


def test_the_examples_in_python_place_photographs(tmp_path: Path, monkeypatch, capsys):
    images = tmp_path / "demo" / "capture" / "images"
    images.mkdir(parents=True)
    (tmp_path / "demo" / LANDMARKS).write_bytes(encode_landmarks(known_place().landmarks))
    for index in (3, 4):
        (images / f"test_00{index}.png").write_bytes(encode_png(photograph(index)[0]))
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for example in re.findall(r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE):
        exec(compile(example, "docs/locate.md", "exec"), names)
        assert "LocalizationBounds(rotation_deg=" in capsys.readouterr().out


def test_the_page_has_every_refusal():
    assert re.findall(r"^\| `([A-Z_]+)`", PAGE, re.MULTILINE) == [reason.value for reason in Reason]
