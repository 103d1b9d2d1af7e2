"""A new export format is one new file: the command line offers it, writes it and reads it, and nothing else changes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

from tests.conftest import ROOT
from tests.support.exported import make_snapshot, write

XYZ = """
import numpy as np
from splatnode.recon.result.snapshot import GaussianArrays

DEFAULT_NAME = "scene.xyz"

def export(result):
    return "".join(f"{x} {y} {z}\\n" for x, y, z in result.gaussians().means.tolist()).encode()

def decode(data, name):
    means = np.array([line.split() for line in data.decode().splitlines()], np.float32)
    n = len(means)
    return GaussianArrays(
        means, np.tile(np.float32([1, 0, 0, 0]), (n, 1)), np.ones((n, 3), np.float32),
        np.full(n, 0.5, np.float32), np.zeros((n, 1, 3), np.float32), np.zeros(n, np.int32),
    )
"""


def test_a_file_dropped_into_a_copy_of_the_package_is_a_format(tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(ROOT / "splatnode", copy / "splatnode", ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "splatnode/recon/result/export/formats/xyz.py").write_text(XYZ)
    write(make_snapshot(), tmp_path / "result")

    def export(*arguments):
        command = [sys.executable, "-m", "splatnode", "export", *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": str(copy)}
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "xyz" in export("--help")
    assert export(tmp_path / "result", "--to", "xyz").strip() == str(tmp_path / "result/scene.xyz")
    assert len((tmp_path / "result/scene.xyz").read_text().splitlines()) == 50
    export(tmp_path / "result/scene.xyz", "--to", "splat", "--out", tmp_path / "back.splat")
    assert (tmp_path / "back.splat").stat().st_size == 50 * 32
