"""An export leaves out what no two photographs confirm, and what is not in a box; old results are told plainly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.result.export import SceneFileError, export_scene, read_gaussians
from splatnode.recon.result.export.limits import Box, Selection
from splatnode.recon.result.export.stored import SOURCES
from splatnode.recon.result.levels_of_detail import remove_unconfirmed
from splatnode.recon.result.report import write_result_folder
from splatnode.recon.result.snapshot import SHELL, encode_unconfirmed
from tests.support.exported import make_gaussians, make_snapshot, write

SEEN = Selection(only_seen=True)


ALL_KINDS = (0, encode_unconfirmed(0), SHELL, 3, encode_unconfirmed(3))


def result(folder, sources=ALL_KINDS):
    gaussians = make_gaussians(50)
    gaussians = replace(gaussians, source_frame=np.resize(np.array(sources, np.int32), 50))
    snapshot = replace(make_snapshot(), gaussians=gaussians)
    write_result_folder(snapshot, folder, seed=0, preset_name="balanced")
    return snapshot


@pytest.mark.parametrize("to", ["ply", "spz", "splat"])
def test_only_what_two_photographs_confirm_is_exported(tmp_path, to):
    snapshot = result(tmp_path)
    back = read_gaussians(export_scene(tmp_path, to, tmp_path / f"seen.{to}", SEEN))
    expected = remove_unconfirmed(snapshot).gaussians
    assert len(back) == 20 == len(expected)
    atol = 1e-3 if to == "spz" else 1e-6
    assert np.allclose(np.sort(back.means[:, 0]), np.sort(expected.means[:, 0]), atol=atol)


def test_without_the_background_all_else_is_exported(tmp_path):
    snapshot = result(tmp_path)
    back = read_gaussians(export_scene(tmp_path, "ply", tmp_path / "near.ply", Selection(no_background=True)))
    near = snapshot.gaussians.source_frame != SHELL
    assert len(back) == near.sum() == 40
    assert np.allclose(np.sort(back.means[:, 0]), np.sort(snapshot.gaussians.means[near, 0]), atol=1e-6)
    result(tmp_path / "far", (SHELL,))
    with pytest.raises(SceneFileError, match="nothing but the far background"):
        export_scene(tmp_path / "far", "ply", tmp_path / "no.ply", Selection(no_background=True))


def test_points_of_colmap_are_selected_too(tmp_path):
    result(tmp_path)
    export_scene(tmp_path, "colmap", tmp_path / "model", SEEN)
    lines = (tmp_path / "model" / "points3D.txt").read_text().splitlines()
    assert len([line for line in lines if not line.startswith("#")]) == 20


def test_the_box_is_in_the_files_frame(tmp_path):
    result(tmp_path)
    box = Box((-1, -3, -3), (2, 3, 0.5))
    back = read_gaussians(export_scene(tmp_path, "ply", tmp_path / "box.ply", Selection(box=box))).means
    every = read_gaussians(tmp_path / "scene.ply").means
    inside = (every[:, 0] >= -1) & (every[:, 0] <= 2) & (every[:, 2] <= 0.5)
    assert 0 < inside.sum() < 50 and np.allclose(back, every[inside])
    both = read_gaussians(export_scene(tmp_path, "ply", tmp_path / "both.ply", Selection(True, box)))
    assert 0 < len(both) < inside.sum()


def test_a_box_that_holds_nothing_is_refused_and_told_where_the_scene_is(tmp_path):
    result(tmp_path)
    far = Selection(box=Box((100, 100, 100), (101, 101, 101)))
    with pytest.raises(SceneFileError, match=r"no Gaussian of scene.ply is in the box.*between -\d"):
        export_scene(tmp_path, "ply", tmp_path / "box.ply", far)
    assert not (tmp_path / "box.ply").exists()


@pytest.mark.parametrize("most", [(1, 0, 1), (1, 1, -2)])
def test_a_box_must_have_an_inside(most):
    with pytest.raises(ValueError, match=r"below [yz]1"):
        Box((0, 0, 0), most)


def test_a_result_without_confirmed_gaussians_is_refused(tmp_path):
    result(tmp_path, sources=(SHELL, encode_unconfirmed(0)))
    with pytest.raises(SceneFileError, match="no Gaussian that two photographs confirm"):
        export_scene(tmp_path, "ply", tmp_path / "seen.ply", SEEN)


def test_a_result_of_an_earlier_version_is_told_plainly(tmp_path):
    write(make_snapshot(), tmp_path)
    with pytest.raises(SceneFileError, match="does not tell which Gaussians.*splatnode replay"):
        export_scene(tmp_path, "ply", tmp_path / "seen.ply", SEEN)
    assert export_scene(tmp_path, "ply", tmp_path / "all.ply").is_file()


def test_a_scene_that_was_edited_is_told_plainly(tmp_path):
    result(tmp_path)
    (tmp_path / SOURCES).write_bytes((tmp_path / SOURCES).read_bytes()[:-4])
    with pytest.raises(SceneFileError, match="49 Gaussians come from.*has 50"):
        export_scene(tmp_path, "ply", tmp_path / "seen.ply", SEEN)


@pytest.mark.parametrize("to", ["tum", "nerfstudio"])
def test_formats_of_cameras_have_nothing_to_leave_out(tmp_path, to):
    result(tmp_path)
    with pytest.raises(ValueError, match="holds cameras and no Gaussians"):
        export_scene(tmp_path, to, tmp_path / "cameras", SEEN)
