"""`python -m tests.bench NAME`: every name is a benchmark; without a name it lists them all."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.__main__ import MODULES, describe
from tests.conftest import ROOT


@pytest.mark.parametrize("name", MODULES)
def test_a_name_is_a_file_with_a_main(name):
    tree = ast.parse(Path(ROOT, *MODULES[name].split(".")).with_suffix(".py").read_text())
    assert "main" in [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]


@pytest.mark.parametrize("name", MODULES)
def test_a_benchmark_says_what_it_measures(name):
    words = describe(name)
    assert 2 <= len(words.split()) <= 30 and "python -m" not in words


def test_all_are_listed_without_a_name():
    listed = subprocess.run([sys.executable, "-m", "tests.bench"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert [line.split()[0] for line in listed.stdout.splitlines()] == sorted(MODULES)
    assert "`python -m tests.bench` lists" in (ROOT / "docs" / "measurement.md").read_text(encoding="utf-8")


def test_a_name_runs_and_another_is_told_which_there_are():
    told, run = (
        subprocess.run([sys.executable, "-m", "tests.bench", *rest], cwd=ROOT, capture_output=True, text=True)
        for rest in (["everything"], ["capture", "--help"])
    )
    assert told.returncode != 0 and "{audit,batch_ray,batch_simulation,bent,beside," in told.stderr
    assert run.returncode == 0 and "--seconds" in run.stdout
