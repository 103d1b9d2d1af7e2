"""The verb map: files and a line, or why there is no map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode import command_line
from splatnode.recon.occupancy import occupancy_map
from splatnode.recon.result.report import write_result_folder
from splatnode.recon.result.verdict import Code
from tests.support.exported import make_snapshot
from tests.support.occupied import room_snapshot

ALWAYS = {"occupancy.npz", "occupancy.bt", "collision.ply", "collision.glb", "map.json"}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("result")
    write_result_folder(room_snapshot(), folder, seed=0, preset_name="fast")
    return folder


def test_a_map_is_written_beside_the_scene(result, capsys):
    assert command_line.main(["occupancy", str(result), "--band", "0.1", "0.5", "--relative"]) == 0
    told = capsys.readouterr().out
    assert "not seen" in told and "up: the floor" in told and "relative (no metric unit)" in told
    assert {path.name for path in (result / "occupancy").iterdir()} == ALWAYS | {"map.pgm", "map.yaml"}
    with np.load(result / "occupancy" / "occupancy.npz", allow_pickle=False) as arrays:
        assert arrays["states"].dtype == np.uint8 and arrays["T_world_map"].shape == (4, 4)
        assert str(arrays["meaning"]) == "0: not_seen, 1: free, 2: occupied"
        assert np.allclose(arrays["origin"] / arrays["voxel"], np.round(arrays["origin"] / arrays["voxel"]))


def test_a_map_goes_through_no_link_of_whoever_made_the_result(tmp_path, capsys):
    result, mine, elsewhere = tmp_path / "result", tmp_path / "mine", tmp_path / "elsewhere"
    write_result_folder(room_snapshot(), result, seed=0, preset_name="fast")
    mine.write_text("mine")
    elsewhere.mkdir()
    (result / "occupancy").symlink_to(elsewhere)
    assert command_line.main(["occupancy", str(result), "--voxel", "0.2"]) == 2
    assert "must be no link; remove it" in capsys.readouterr().err and not any(elsewhere.iterdir())
    (result / "occupancy").unlink()
    (result / "occupancy").mkdir()
    for name in ALWAYS:
        (result / "occupancy" / name).symlink_to(mine)
    assert command_line.main(["occupancy", str(result), "--voxel", "0.2"]) == 0
    assert mine.read_text() == "mine" and not any(path.is_symlink() for path in (result / "occupancy").iterdir())


def test_without_a_band_there_is_nothing_for_nav2(result, tmp_path, capsys):
    assert (
        command_line.main(["occupancy", str(result), "--out", str(tmp_path), "--voxel", "0.05", "--up", "0", "0", "1"])
        == 0
    )
    assert {path.name for path in tmp_path.iterdir()} == ALWAYS
    assert "--band LOW HIGH" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("snapshot", "code", "said"),
    [
        (make_snapshot(Code.NO_OVERLAP, False), 65, "refused: NO_OVERLAP"),
        (replace(room_snapshot(), depths={}), 65, "no depth.npz"),
    ],
)
def test_of_a_result_that_is_not_sure_there_is_none(tmp_path, capsys, snapshot, code, said):
    write_result_folder(snapshot, tmp_path, seed=0, preset_name="fast")
    assert command_line.main(["occupancy", str(tmp_path)]) == code
    assert said in capsys.readouterr().err and not (tmp_path / "occupancy").exists()


def test_a_map_of_an_earlier_band_or_result_does_not_stay(tmp_path, capsys):
    write_result_folder(room_snapshot(), tmp_path, seed=0, preset_name="fast")
    folder = tmp_path / "occupancy"
    assert command_line.main(["occupancy", str(tmp_path), "--band", "0.1", "0.5", "--relative"]) == 0
    assert command_line.main(["occupancy", str(tmp_path), "--voxel", "0.1"]) == 0
    assert {path.name for path in folder.iterdir()} == ALWAYS
    (folder / "mine.txt").write_text("somebody else's")
    (folder / "collision.ply").write_text("changed by hand")
    write_result_folder(make_snapshot(Code.NO_OVERLAP, False), tmp_path, seed=0, preset_name="fast")
    assert {path.name for path in folder.iterdir()} == {"mine.txt", "collision.ply"}


def test_a_voxel_of_numpy_is_written_as_a_number(tmp_path):
    occupancy_map(room_snapshot(), np.float64(0.05)).save(tmp_path, (0.1, 0.5), relative=True)
    assert "resolution: 0.05\n" in (tmp_path / "map.yaml").read_text()
    assert b"\nres 0.05\n" in (tmp_path / "occupancy.bt").read_bytes()


@pytest.mark.parametrize("arguments", [["--band", "0.5", "0.1"], ["--band", "-9", "0.1"], ["--voxel", "1e-6"]])
def test_what_cannot_be_used_writes_nothing(result, tmp_path, capsys, arguments):
    assert command_line.main(["occupancy", str(result), "--out", str(tmp_path / "new"), *arguments]) == 2
    assert not (tmp_path / "new").exists() and capsys.readouterr().err.count("\n") == 1


def test_a_folder_that_is_not_there_is_told(tmp_path, capsys):
    assert command_line.main(["occupancy", str(tmp_path / "nothing")]) == 2
    assert "is no folder" in capsys.readouterr().err
