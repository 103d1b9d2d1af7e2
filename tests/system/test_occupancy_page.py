"""The example of docs/occupancy.md runs, on a small result, as it is printed; its table of files is that of a map."""

from __future__ import annotations

import re
from pathlib import Path

from splatnode.recon.occupancy import VoxelState
from splatnode.recon.result.report import write_result_folder
from tests.conftest import ROOT
from tests.support.occupied import room_snapshot

PAGE = (ROOT / "docs" / "occupancy.md").read_text(encoding="utf-8")


def test_the_example_in_python_makes_a_map(tmp_path: Path, monkeypatch, capsys):
    write_result_folder(room_snapshot(), tmp_path / "demo", seed=0, preset_name="fast")
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    exec(compile(example, "docs/occupancy.md", "exec"), {})
    assert "the floor, a plane through" in capsys.readouterr().out
    (files,) = re.findall(r"^\| file \|.*?\n\n", PAGE, re.DOTALL | re.MULTILINE)
    written = {path.name for path in (tmp_path / "demo" / "nav").iterdir()}
    assert set(re.findall(r"`([\w.]+\.(?:npz|bt|pgm|yaml|json|ply|glb))`", files)) == written


def test_the_page_has_every_state():
    told = {int(number): name for name, number in re.findall(r"^\| ([a-z ]+) \((\d)\) \|", PAGE, re.MULTILINE)}
    assert told == {state.value: state.name.lower().replace("_", " ") for state in VoxelState}
