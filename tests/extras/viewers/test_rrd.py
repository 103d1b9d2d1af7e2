"""scene.rrd, read back with rerun's own reader."""

from __future__ import annotations

import sys
from typing import Any

import cv2
import numpy as np
import pytest

from splatnode.capture.process.system import remedy
from splatnode.recon.result import export
from splatnode.recon.result.export import export_scene
from splatnode.recon.result.stored_snapshot import LANDMARKS, encode_landmarks
from tests.support.exported import make_gaussians, make_landmarks, make_snapshot, write


@pytest.fixture
def folder(tmp_path):
    result = tmp_path / "result"
    write(make_snapshot(), result, further={LANDMARKS: encode_landmarks(make_landmarks())})
    (result / "images").mkdir()
    cv2.imwrite(str(result / "images" / "0000.jpg"), np.full((768, 1024, 3), (200, 100, 50), np.uint8))  # BGR
    return result


def read(path) -> dict[str, dict[str, Any]]:
    """By entity, what its first row has: each component by its name."""
    chunks = pytest.importorskip("rerun.chunk", reason="needs rerun")
    found: dict[str, dict[str, Any]] = {}
    for chunk in chunks.RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        columns = zip(batch.schema.names, batch.columns, strict=True)
        values = {name: column[0].as_py() for name, column in columns}
        found.setdefault(chunk.entity_path, {}).update(values)
    return found


def test_without_rerun_it_says_what_to_install(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "splatnode.extras.viewers.rerun", raising=False)
    monkeypatch.delattr(export, "rerun", raising=False)  # a test that ran before may have loaded it
    with pytest.raises(ModuleNotFoundError) as lacking:
        export_scene(folder, "rrd", tmp_path / "scene.rrd")
    assert remedy(lacking.value.name) == "Run: pip install 'splatnode[rerun]'"
    assert not (tmp_path / "scene.rrd").exists()


def test_a_result_is_read_back(folder, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun")
    found = read(export_scene(folder, "rrd", tmp_path / "scene.rrd"))
    text = found["/verdict"]["TextDocument:text"][0]
    assert text.startswith("# OK\n\nSaid in one sentence.\n\nDo this.") and "- 0001.jpg: blurred" in text
    camera, gaussians = found["/world/cameras/0002.jpg"], found["/world/gaussians"]
    assert np.allclose(camera["Transform3D:translation"], [[2, -0.5, 0.25]])
    turn = np.reshape(camera["Transform3D:mat3x3"][0], (3, 3)).T  # rerun's matrices are by column
    assert np.allclose(turn @ (0, 0, 1), (np.sin(-0.7), 0, np.cos(-0.7)))
    assert np.allclose(camera["Pinhole:image_from_camera"], [[400, 0, 0, 0, 410, 0, 256, 192, 1]])
    assert camera["Pinhole:resolution"] == [[512, 384]] and "EncodedImage:blob" not in camera
    expected = make_gaussians()
    order = np.argsort(expected.means[:, 0])
    shown = np.argsort(np.array(gaussians["GaussianSplats3D:centers"])[:, 0])
    for name, values in [
        ("centers", expected.means),
        ("scales", expected.scales),
        ("quaternions", expected.quats[:, [1, 2, 3, 0]]),
    ]:
        assert np.allclose(np.array(gaussians[f"GaussianSplats3D:{name}"])[shown], values[order], atol=1e-5), name
    opacities = np.array(gaussians["GaussianSplats3D:colors"])[shown] & 255  # RGBA, alpha last
    assert np.allclose(opacities / 255, expected.opacities[order], atol=0.005)
    higher = np.array(gaussians["GaussianSplats3D:sh_coefficients"]).reshape(-1, 15, 3)[shown]
    assert np.allclose(higher[:, :3], expected.sh[order, 1:], atol=1e-3) and not higher[:, 3:].any()
    assert np.allclose(found["/world/landmarks"]["Points3D:positions"], make_landmarks().points, atol=1e-6)


def test_the_photograph_is_of_the_camera_s_size_and_rgb(folder, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun")
    [data] = read(export_scene(folder, "rrd", tmp_path / "scene.rrd"))["/world/cameras/0000.jpg"]["EncodedImage:blob"]
    pixels = cv2.imdecode(np.asarray(data, np.uint8).copy(), cv2.IMREAD_COLOR)
    assert pixels.shape == (384, 512, 3) and np.abs(pixels.astype(int) - (200, 100, 50)).max() < 5
