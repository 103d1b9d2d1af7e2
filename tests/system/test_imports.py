"""Rooms that run without torch load where torch cannot be imported. The arrows themselves are import-linter's."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.system.test_sizes import ROOMS

NO_TORCH = """
import sys
sys.modules["torch"] = None  # importing it raises ImportError
import {module}
assert not [name for name in sys.modules if name.startswith("torch.")]
"""


@pytest.mark.parametrize(
    "module",
    [
        "splatnode.capture.cli",
        "splatnode.extras.cameras.building",
        "splatnode.capture.cameras.synthetic",
        "recon",
        "splatnode.recon.result.snapshot",
        "splatnode.recon.result.verdict",
        "splatnode.recon.result.export",
        "splatnode.recon.result.report",
        "splatnode.recon.result.message",
        "viewer",
        "tests.conftest",  # of which children of tests take ROOT
    ],
)
def test_loads_without_torch(module):
    result = subprocess.run(
        [sys.executable, "-c", NO_TORCH.format(module=module)], cwd=ROOT, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr


def test_the_block_bites():
    result = subprocess.run(
        [sys.executable, "-c", NO_TORCH.format(module="splatnode.recon.scene")],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert result.returncode != 0 and "torch" in result.stderr


def test_the_core_loads_with_the_standard_library_alone():
    """The build backend imports it before anything is installed: site-packages is left out (-S)."""
    code = "import sys; sys.path.insert(0, '.'); from splatnode.recon.core import compile; print(compile.machine())"
    subprocess.run([sys.executable, "-I", "-S", "-c", code], cwd=ROOT, check=True)


def test_a_users_own_modules_may_have_the_names_of_our_rooms(tmp_path):
    """Python puts a script's folder first: what the rooms import must not be the user's capture.py."""
    for name in ("capture", "recon", "viewer", "tests"):
        (tmp_path / f"{name}.py").write_text(f"owner = 'the user, of {name}'\n")
    script = tmp_path / "script.py"
    script.write_text(
        "import capture, recon, viewer\n"
        "from splatnode.command_line import build_parser\n"
        "from splatnode.recon.pipeline import reconstruct\n"
        "from splatnode.viewer import session\n"
        "print(capture.owner, recon.owner, viewer.owner, sep='; ')\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    printed = subprocess.check_output([sys.executable, str(script)], cwd=tmp_path, env=environment, text=True)
    assert printed == "the user, of capture; the user, of recon; the user, of viewer\n"


def find_hidden_modules(root: Path) -> Iterator[str]:
    """Yields the modules whose names their package gives to something else: `from package import module` finds that."""
    for room in ROOMS:
        for package in sorted((root / room).rglob("__init__.py")):
            folder = package.parent
            own = {path.stem if path.suffix == ".py" else path.name for path in folder.iterdir()}
            name = ".".join(("splatnode", *folder.relative_to(root).parts)).replace("splatnode.splatnode", "splatnode")
            for node in ast.parse(package.read_text()).body:
                if isinstance(node, ast.ImportFrom) and node.module != name:
                    bound = {alias.asname or alias.name for alias in node.names}
                elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                    bound = {node.name}
                else:
                    continue
                yield from (f"{name}.{each}" for each in sorted(bound & own))


def test_a_package_hides_no_module_of_its_own():
    assert list(find_hidden_modules(ROOT)) == []


def test_a_module_that_its_package_hides_is_named(tmp_path):
    folder = tmp_path / "extras" / "batch"
    folder.mkdir(parents=True)
    lines = ("from splatnode.extras.cameras import mcap", "from splatnode.extras.batch import ray")
    (folder / "__init__.py").write_text("\n".join(lines))
    for name in ("mcap", "ray"):
        (folder / f"{name}.py").write_text("")
    assert list(find_hidden_modules(tmp_path)) == ["splatnode.extras.batch.mcap"]
