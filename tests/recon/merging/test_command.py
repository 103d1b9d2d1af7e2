"""`splatnode merge`: what it writes, what it says, and what it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest

import splatnode
from splatnode.command_line import main
from splatnode.recon.occupancy import VoxelState
from splatnode.recon.result.export import read_cameras, read_gaussians
from splatnode.recon.result.stored_snapshot import find_pieces
from splatnode.recon.result.submap_index import read_map_set
from splatnode.recon.result.verdict import Code
from tests.support.walk import place, walk, write_walk

PROVISIONAL = place("scene-0003", folder="scene-0003", verdict="OK", publishable=True, provisional=True)


@pytest.fixture(scope="module")
def merged_out(tmp_path_factory):
    """A node's folder that was merged, and the report."""
    out = write_walk(tmp_path_factory.mktemp("out"), further=(place("scene-0009"),))
    assert main(["merge", str(out)]) == 0
    return out


def test_a_map_becomes_one_result(merged_out):
    folder = merged_out / "map-scene-0001"
    report = json.loads((folder / "report.json").read_text())
    gaussians = read_gaussians(folder / "scene.ply")
    given = sum(len(scene.gaussians) for scene in walk())
    assert len(gaussians) == report["num_gaussians"] < 0.85 * given and report["gaussians_given"] == given
    assert report["verdict"]["code"] == "OK" and report["verdict"]["publishable"]
    assert [each["scene"] for each in report["scenes"]] == ["scene-0001", "scene-0002"]
    kept = sum(each["kept"] for each in report["scenes"])
    assert kept + report["far_shell"] == len(gaussians)
    assert all(each["kept"] <= each["after_seams"] <= each["gaussians"] for each in report["scenes"])
    assert len(read_cameras(folder / "cameras.json")) == 6
    listed = json.loads((folder / "manifest.json").read_text())["files"]
    assert {"scene.ply", "levels.json", "colmap/points3D.txt", "preview.png", "pieces/scene-0002.ply"} <= set(listed)


AHEAD = np.array([[0.6, 0.0, 0.5], [2.4, 0.0, 0.6]])  # between the wall and the cameras: of the first scene, the second


@pytest.mark.parametrize("second", [Code.OK, Code.OK_ROUGH])
def test_free_space_is_mapped_through_all_scenes_that_are_known_well(tmp_path, second):
    out = write_walk(tmp_path / "out", second=second)
    assert main(["merge", str(out)]) == 0
    found = splatnode.load(out / "map-scene-0001").map(voxel=0.05)
    mapped = VoxelState.FREE if second is Code.OK else VoxelState.NOT_SEEN
    assert found.at(AHEAD).tolist() == [VoxelState.FREE, mapped]
    on_wall = AHEAD * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
    assert found.at(on_wall).tolist() == [
        VoxelState.OCCUPIED,
        VoxelState.OCCUPIED if second is Code.OK else VoxelState.NOT_SEEN,
    ]


def test_the_pieces_are_the_whole(merged_out):
    whole = read_map_set(merged_out)
    pieces = find_pieces(whole, whole.maps[0], merged_out)
    assert pieces.merged
    parts = np.concatenate([piece.load_gaussians().means for piece in pieces.pieces])
    every = read_gaussians(merged_out / "map-scene-0001" / "scene.ply").means
    assert np.allclose(parts[np.lexsort(parts.T)], every[np.lexsort(every.T)])


def test_each_level_tells_from_where_it_suffices(tmp_path):
    out = write_walk(tmp_path / "out", step=0.02)
    assert main(["merge", str(out), "--out", str(tmp_path / "there")]) == 0
    folder = tmp_path / "there" / "map-scene-0001"
    told = json.loads((folder / "levels.json").read_text())
    assert told["levels"] and not (out / "map-scene-0001").exists()
    for level in told["levels"]:
        assert len(read_gaussians(folder / level["file"])) == level["num_gaussians"]
        assert level["from_distance"] == pytest.approx(told["focal_px"] * level["voxel"])


def test_what_cannot_be_merged_is_told(merged_out, tmp_path, capsys):
    out = write_walk(tmp_path, further=(place("scene-0009"),))
    index = json.loads((out / "places.json").read_text())
    index["places"].append(PROVISIONAL)
    index["poses"].append({**index["poses"][1], "scene": "scene-0003"})
    (out / "places.json").write_text(json.dumps(index))
    assert main(["merge", str(out), "--max-gaussians", "800", "--json"]) == 0
    (report,) = json.loads(capsys.readouterr().out).values()
    assert report["num_gaussians"] <= 800
    assert report["scenes_left_out"] == [{"scene": "scene-0003", "reason": "its scene is not final yet"}]


def test_megabytes_bound_the_file(tmp_path):
    out = write_walk(tmp_path)
    assert main(["merge", str(out), "--max-mb", "0.05"]) == 0
    assert 0.03e6 < (out / "map-scene-0001" / "scene.ply").stat().st_size <= 0.05e6


def test_bad_input_is_refused_in_a_line_and_leaves_nothing(tmp_path, capsys):
    assert main(["merge", str(tmp_path)]) == 2
    assert "places.json is not there" in capsys.readouterr().err
    out = write_walk(tmp_path)
    ply = out / "scene-0002" / "scene.ply"
    ply.write_bytes(ply.read_bytes()[:-100])
    assert main(["merge", str(out)]) == 2
    said = capsys.readouterr().err
    assert "scene-0002" in said and "truncated" in said and "Traceback" not in said
    assert not (out / "map-scene-0001").exists()


def test_a_folder_without_a_scene_is_no_success(tmp_path, capsys):
    index = {"checkpoint": "0" * 32, "places": [place("scene-0001")], "links": [], "poses": []}
    (tmp_path / "places.json").write_text(json.dumps(index))
    assert main(["merge", str(tmp_path)]) == 65
    assert "nothing to merge (scene-0001: it has no result: NO_PARALLAX)" in capsys.readouterr().out
