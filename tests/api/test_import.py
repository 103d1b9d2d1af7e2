"""`import splatnode` takes no time, and what it gives is there when it is asked for."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys

import pytest

import splatnode
from tests.conftest import ROOT

LONGEST_S = 0.15
TIMED = """
import sys, time
began = time.perf_counter()
import splatnode
print(time.perf_counter() - began)
assert not {"torch", "numpy", "cv2", "scipy"} & set(sys.modules)
"""


def test_it_takes_no_time_and_brings_nothing():
    took = [float(subprocess.check_output([sys.executable, "-c", TIMED], cwd=ROOT, text=True)) for _ in range(3)]
    assert min(took) < LONGEST_S


@pytest.mark.parametrize("name", splatnode.__all__)
def test_every_name_is_there_and_documented(name):
    found = getattr(splatnode, name)
    assert inspect.getdoc(found) and name in dir(splatnode)


def test_an_editor_sees_the_names_that_there_are():
    (checked,) = [node for node in ast.parse(inspect.getsource(splatnode)).body if isinstance(node, ast.If)]
    imported = {
        alias.name: f"{node.module}"
        for node in checked.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert imported == splatnode._MODULES and sorted(imported) == splatnode.__all__


def test_another_name_is_not_there():
    with pytest.raises(AttributeError, match="has no attribute 'recnstruct'; it has: Camera, "):
        splatnode.recnstruct  # noqa: B018


@pytest.mark.parametrize("names", ["Result, load", "connect, Node", "Camera, View"])
def test_what_computes_nothing_needs_no_torch(names):
    code = f"import sys; sys.modules['torch'] = None; from splatnode import {names}"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
