"""Rooms that run without torch load where torch cannot be imported. The arrows themselves are import-linter's."""

from __future__ import annotations

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
        "capture.cli",
        "capture.cameras.synthetic",
        "recon",
        "recon.snapshot",
        "recon.verdict",
        "recon.export",
        "recon.preview",
        "recon.report",
        "recon.daemon.scene_message",
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
        [sys.executable, "-c", NO_TORCH.format(module="recon.gaussians")], cwd=ROOT, capture_output=True, text=True
    )
    assert result.returncode != 0 and "torch" in result.stderr


def test_the_core_loads_with_the_standard_library_alone():
    """The build backend imports it before anything is installed: site-packages is left out (-S)."""
    code = "import sys; sys.path.insert(0, '.'); import recon.core.compile; print(recon.core.compile.machine())"
    subprocess.run([sys.executable, "-I", "-S", "-c", code], cwd=ROOT, check=True)
