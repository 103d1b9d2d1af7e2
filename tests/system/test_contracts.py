"""The import contracts of pyproject.toml bite: in a copy of the product with wrong imports, each of them is named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

# Who must not import whom: at least one wrong arrow for each contract, and one for each pair of neighbouring stages.
WRONG = (
    ("splatnode.capture.keyframe_selection", "splatnode.recon.geometry"),
    ("splatnode.recon.result.report", "splatnode.viewer.state"),
    ("splatnode.recon.threads", "splatnode.command_line"),
    ("splatnode.recon.keyframes", "splatnode.recon.matching.features"),
    ("splatnode.recon.matching.features", "splatnode.recon.registration.bundle_adjustment"),
    ("splatnode.recon.registration.bundle_adjustment", "splatnode.recon.verification.evidence"),
    ("splatnode.recon.verification.evidence", "splatnode.recon.priors"),
    ("splatnode.recon.priors", "splatnode.recon.scene.initialization"),
    ("splatnode.recon.scene.initialization", "splatnode.recon.rasterize.reference"),
    ("splatnode.recon.rasterize.reference", "splatnode.recon.optimize.photometric_losses"),
    ("splatnode.recon.optimize.photometric_losses", "splatnode.recon.config"),
    ("splatnode.recon.config", "splatnode.recon.pipeline"),
    ("splatnode.recon.pipeline", "splatnode.extras.evaluate.protocol"),
    ("splatnode.extras.jobs.template", "splatnode.extras.evaluate.protocol"),
    ("splatnode.recon.verbs", "splatnode.extras.verbs"),
    ("splatnode.recon.daemon", "splatnode.extras.evaluate.protocol"),
    ("splatnode.recon.core.compile", "splatnode.recon.networks.lpips"),
    ("splatnode.capture.process.files", "splatnode.capture.frame"),
    ("splatnode.viewer.state", "splatnode.api.result"),
    ("splatnode.api.result", "splatnode.command_line"),
    ("splatnode.recon.replay_source", "splatnode.recon.pipeline"),
    ("splatnode.viewer.state", "splatnode.recon.scene"),
    ("splatnode.viewer.session", "torch"),
    ("splatnode.recon.result.snapshot", "torch"),
    ("splatnode.recon.core.backend", "numpy"),
    ("splatnode.capture.cameras.folder", "open3d"),
)


@pytest.fixture
def product(tmp_path: Path) -> Path:
    """A copy of the product and its contracts, links among the rooms included."""
    for room in ("capture", "recon", "viewer", "extras", "splatnode"):
        without = shutil.ignore_patterns("_core_*", "__pycache__", ".build-*")
        shutil.copytree(ROOT / room, tmp_path / room, symlinks=True, ignore=without)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def lint(project: Path) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    return subprocess.run(command, cwd=project, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"})


def test_the_copy_is_what_is_checked(product):
    """Without a wrong import nothing is broken."""
    done = lint(product)
    assert done.returncode == 0, done.stdout


def test_every_wrong_import_is_named_and_breaks_its_contract(product):
    for importer, imported in WRONG:
        room = product / importer.replace(".", "/")
        with (room / "__init__.py" if room.is_dir() else room.with_suffix(".py")).open("a") as file:
            file.write(f"\nimport {imported}\n")
    done = lint(product)
    assert done.returncode != 0
    assert [arrow for arrow in WRONG if f"{' -> '.join(arrow)} (l." not in done.stdout] == []
    assert " KEPT" not in done.stdout


def test_a_new_room_of_recon_must_take_its_place(product):
    (product / "recon" / "attic.py").write_text("")
    done = lint(product)
    assert done.returncode != 0 and "attic" in done.stdout
