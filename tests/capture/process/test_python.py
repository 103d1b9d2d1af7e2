"""Python that is started: it runs nothing of the folder in which that happens, and finds what its parent has."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

import splatnode
import splatnode.capture as capture_room
from splatnode.capture.process import python
from tests.support.hostile_folder import MODULES, make_hostile

TOLD = """
import json, sys, splatnode, splatnode.capture
print(json.dumps([splatnode.__file__, splatnode.capture.__path__[0], sys.argv[1:], sys.path, sys.flags.isolated]))
"""


def test_it_runs_no_module_of_the_current_folder_and_finds_our_splatnode(tmp_path, monkeypatch):
    trace = make_hostile(tmp_path / "photos")
    (tmp_path / "user").mkdir()
    (tmp_path / "user" / "told.py").write_text(TOLD)
    monkeypatch.chdir(tmp_path / "photos")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([".", "", str(tmp_path / "photos"), str(tmp_path / "user")]))
    monkeypatch.setattr(sys, "path", ["", str(tmp_path / "photos"), str(tmp_path / "user"), *sys.path])
    done = subprocess.run(python.command("told", "a b", "-x"), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    package, capture, arguments, path, isolated = json.loads(done.stdout)
    assert package == splatnode.__file__ and capture == capture_room.__path__[0]
    assert arguments == ["a b", "-x"] and isolated == 1 and not trace.exists()
    assert str(tmp_path / "user") in path and not {"", ".", str(tmp_path / "photos")} & set(path)


@pytest.mark.parametrize("told", [("-c", "import json"), ("-S", "-c", "import json")], ids=["site", "bare"])
def test_an_isolated_python_does_not_either(tmp_path, monkeypatch, told):
    trace = make_hostile(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert subprocess.run(python.make_isolated_command(*told)).returncode == 0 and not trace.exists()


def test_python_m_leaves_the_current_folder_before_it_imports_anything(tmp_path, monkeypatch):
    trace = make_hostile(tmp_path)
    for name in set(MODULES) - {"argparse", "msgspec", "numpy", "typing"}:  # nothing can be done about splatnode.py
        (tmp_path / f"{name}.py").unlink()
    monkeypatch.setenv("PYTHONPATH", os.path.dirname(os.path.dirname(splatnode.__file__)))
    done = subprocess.run([sys.executable, "-m", "splatnode"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and "VERB" in done.stderr and not trace.exists()


def test_a_module_is_found_where_its_package_lies():
    assert python.place_of("splatnode.extras.jobs") is None
    assert python.place_of(__name__) == os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(__file__))))
    assert python.place_of("tomllib_that_is_not_there") is None
