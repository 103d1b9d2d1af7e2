"""Rooms that run without torch load where torch cannot be imported. The arrows themselves are import-linter's."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.conftest import ROOT

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
        "splatnode.recon.result.report",
        "splatnode.recon.result.message",
        "viewer",
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
