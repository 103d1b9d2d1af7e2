"""`python -m tests.bench NAME`: every name is a benchmark, and docs/measurement.md names them all."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.__main__ import MODULES
from tests.conftest import ROOT


@pytest.mark.parametrize("name", MODULES)
def test_a_name_is_a_file_with_a_main(name):
    tree = ast.parse(Path(ROOT, *MODULES[name].split(".")).with_suffix(".py").read_text())
    assert "main" in [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]


def test_the_names_of_the_page_are_all():
    _, _, section = (ROOT / "docs" / "measurement.md").read_text().partition("\n`python -m tests.bench NAME`")
    table, _, _ = section.partition("\n## ")
    listed = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    assert sorted(listed) == sorted(MODULES)


def test_a_name_runs_and_another_is_told_which_there_are():
    told, run = (
        subprocess.run([sys.executable, "-m", "tests.bench", *rest], cwd=ROOT, capture_output=True, text=True)
        for rest in (["everything"], ["capture", "--help"])
    )
    assert told.returncode != 0 and "{audit,batch_ray,batch_simulation,bent,beside," in told.stderr
    assert run.returncode == 0 and "--seconds" in run.stdout
