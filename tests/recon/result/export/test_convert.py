"""Results exported to other formats, and read back."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.export import SceneFileError, export_scene, read_gaussians, write_beside
from tests.support.exported import make_gaussians, make_snapshot, write


@pytest.mark.parametrize("to", ["ply", "spz", "splat"])
def test_result_is_exported_as_a_scene_that_reads_back(tmp_path, to):
    write(make_snapshot(), tmp_path)
    path = export_scene(tmp_path, to, tmp_path / f"copy.{to}")
    back = read_gaussians(path)
    assert len(back) == 50
    atol = 1e-3 if to == "spz" else 1e-5  # a fiftieth of an extent
    assert np.allclose(np.sort(back.means[:, 0]), np.sort(make_gaussians().means[:, 0]), atol=atol)


def test_result_is_exported_as_cameras(tmp_path):
    write(make_snapshot(), tmp_path)
    export_scene(tmp_path, "colmap", tmp_path / "model")
    assert (tmp_path / "model" / "images.txt").read_bytes() == (tmp_path / "colmap" / "images.txt").read_bytes()
    export_scene(tmp_path / "scene.ply", "nerfstudio", tmp_path / "ns.json")
    assert (tmp_path / "ns.json").read_bytes() == (tmp_path / "transforms.json").read_bytes()
    export_scene(tmp_path, "tum", tmp_path / "t.tum")
    assert (tmp_path / "t.tum").read_bytes() == (tmp_path / "trajectory.tum").read_bytes()


def test_export_of_what_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="splatnode replay"):
        export_scene(tmp_path, "ply", tmp_path / "x.ply")
    with pytest.raises(ValueError, match="one of colmap, dataset, mcap, nerfstudio"):
        export_scene(tmp_path, "obj", tmp_path / "x.obj")
    (tmp_path / "scene.txt").write_text("text")
    with pytest.raises(SceneFileError, match="must end with"):
        export_scene(tmp_path / "scene.txt", "ply", tmp_path / "x.ply")


@pytest.mark.parametrize("inside", [True, False])
def test_an_export_to_the_same_place_leaves_nothing_of_the_one_before(tmp_path, inside):
    """COLMAP would read the binary files of an earlier scene in place of the text beside them."""
    write(make_snapshot(), tmp_path / "out")
    place = tmp_path / ("out/model" if inside else "model")
    write_beside(place, {"cameras.bin": b"1", "images.bin": b"2", "points3D.bin": b"3"}, tmp_path / "out")
    (place / "images.bin").write_bytes(b"mine")
    export_scene(tmp_path / "out", "colmap", place)
    assert sorted(path.name for path in place.iterdir() if path.suffix != ".json") == [
        "cameras.txt",
        "images.bin",
        "images.txt",
        "points3D.txt",
    ]
    assert (place / "images.bin").read_bytes() == b"mine"
