"""An installation without extras captures, reconstructs, serves a node and shows, and imports no optional package."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from splatnode.capture.process.plugins import entry_points
from splatnode.capture.process.system import EXTRAS
from tests.conftest import ROOT

GROUPS = ("verbs", "cameras", "recordings", "priors", "export_formats", "viewers")
MODULES = {entry.module for group in GROUPS for entry in entry_points(f"splatnode.{group}").values()}
# Optional packages cannot be imported: None in sys.modules says that there is none.
MISSION = f"""
import json, pathlib, sys
sys.modules |= dict.fromkeys({sorted(EXTRAS)!r})
from splatnode.command_line import main
pathlib.Path("camera.yaml").write_text("camera: {{kind: synthetic, views: 4, width: 192, height: 144}}")
assert main(["record", "camera.yaml", "--out", "recording"]) == 0
assert main(["replay", "recording", "--out", "out", "--preset", "preview", "--size", "128"]) == 0
assert main(["export", "out", "--to", "spz"]) == 0
assert main(["view", "out", "--headless", "--num-frames", "1", "--size", "64x48"]) == 0
import splatnode.api.reconstruct, splatnode.capture.daemon, splatnode.recon.daemon.node
import splatnode.viewer.cli
print(json.dumps([name for name, module in sys.modules.items() if module is not None]))
"""


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package without the room `extras`, and without what this names and still lies elsewhere."""
    copy = tmp_path_factory.mktemp("core") / "copy"
    ignored = shutil.ignore_patterns("__pycache__", "extras", ".build-*")
    shutil.copytree(ROOT / "splatnode", copy / "splatnode", ignore=ignored)
    for module in MODULES:
        place = copy / module.replace(".", "/")
        shutil.rmtree(place, ignore_errors=True)
        place.with_suffix(".py").unlink(missing_ok=True)
    return copy


def test_the_mission_runs_without_extras_and_without_optional_packages(core, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(core)}
    done = subprocess.run(
        [sys.executable, "-c", MISSION], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    loaded = set(json.loads(done.stdout.splitlines()[-1]))
    assert {"splatnode.recon.daemon.node", "splatnode.capture.daemon"} <= loaded
    assert not loaded & MODULES
    assert not [name for name in loaded if name.split(".")[0] in EXTRAS or name.startswith("splatnode.extras")]
    assert (tmp_path / "out" / "scene.spz").is_file() and list((tmp_path / "out" / "view").iterdir())
