"""What a scene file may make its reader do: nothing but what its bytes are worth, and a clear error for the rest."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path

import numpy as np
import pytest

from splatnode.command_line import main
from splatnode.recon.result.export import SceneFileError, read_cameras, read_gaussians
from splatnode.recon.result.export.limits import BYTES_A_VALUE, MAX_JSON_BYTES, check_count, count_values
from splatnode.recon.result.export.stored import StoredResult
from splatnode.viewer.sources import load_result
from tests.support.crafted import Crafted, camera_files, scene_files
from tests.support.crafted.bounded import MARGIN, readings

GOOD = {"no_gaussian.ply", "subnormal.ply", "wide.splat", "tiny.splat"}
GOOD |= {"extensions.spz", "none.spz", "infinite.splat", "letters.ply"}


def read_scene(file: Crafted) -> str:
    """For the process that reads the corpus."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, file.name)
        path.write_bytes(file.data)
        gaussians = read_gaussians(path)
        for values in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh):
            assert np.isfinite(values).all()
        return f"{len(gaussians)} Gaussians"


def read_camera_file(file: Crafted) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "cameras.json")
        path.write_bytes(file.data)
        StoredResult(path.with_name("scene.ply")).scale()
        return f"{len(read_cameras(path))} cameras"


def test_every_crafted_scene_is_refused_by_name_or_read_in_bounded_memory():
    for reading in readings("tests.support.crafted:scene_files", f"{__name__}:read_scene"):
        refused = reading.outcome.startswith("SceneFileError: ") and reading.name in reading.outcome
        assert refused or (reading.outcome.endswith("Gaussians") and reading.name in GOOD), reading
        assert reading.taken <= BYTES_A_VALUE * count_values(16) * reading.size // 4 + MARGIN, reading


def test_every_crafted_camera_file_is_refused_by_name():
    for reading in readings("tests.support.crafted:camera_files", f"{__name__}:read_camera_file"):
        assert reading.outcome.startswith("SceneFileError: cameras.json"), reading
        assert reading.taken <= 2 * MAX_JSON_BYTES + MARGIN and len(reading.outcome) < 2000, reading


@pytest.mark.parametrize("verb", [["export", "--to", "splat"], ["view", "--headless"]])
def test_a_crafted_file_ends_a_command_with_2(verb, tmp_path, capsys):
    for file in itertools.islice(scene_files(), 20):
        if file.name in GOOD:
            continue
        path = tmp_path / file.name
        path.write_bytes(file.data)
        assert main([verb[0], str(path), *verb[1:]]) == 2
        assert file.name in capsys.readouterr().err
    (tmp_path / "scene.ply").write_bytes(b"")
    for file in camera_files():
        (tmp_path / "cameras.json").write_bytes(file.data)
        assert main(["export", str(tmp_path), "--to", "tum"]) == 2
        assert "cameras.json" in capsys.readouterr().err


REPORTS = {
    "deep": b'{"verdict":' + b"[" * 100_000,
    "list": b"[]",
    "number": b'{"verdict": {"code": "OK", "message": "a", "advice": ""}, "iterations": 1e400}',
    "negative": b'{"verdict": {"code": "OK", "message": "a", "advice": ""}, "iterations": -1}',
    "code": b'{"verdict": {"code": "FINE", "message": "a", "advice": ""}}',
    "escape": b'{"verdict": {"code": "OK", "message": "\\u001b[2J", "advice": ""}}',
    "turned": b'{"verdict": {"code": "OK", "message": "a", "advice": "\\u202e"}}',
    "names": b'{"verdict": {"code": "OK", "message": "a", "advice": "", "frames": ["a\\nb"]}}',
    "seconds": b'{"verdict": {"code": "OK", "message": "a", "advice": ""}, "seconds": {"x": 1e300}}',
}


@pytest.mark.parametrize("report", REPORTS)
def test_a_crafted_report_is_refused_by_name(report, tmp_path):
    (tmp_path / "report.json").write_bytes(REPORTS[report])
    with pytest.raises(SceneFileError, match="report.json"):
        load_result(tmp_path)


def test_the_number_of_gaussians_is_bounded_by_their_values():
    check_count(10_000_000, 1, "a.ply")
    with pytest.raises(SceneFileError, match="a.ply promises 6000000 Gaussians; at most 5833333 with 16 coefficients"):
        check_count(6_000_000, 16, "a.ply")
