"""`splatnode replay --map`, as it is typed."""

from __future__ import annotations

import json

import pytest

from splatnode import command_line
from splatnode.capture.image_file import encode_png
from splatnode.recon.result.export import export_scene, read_cameras
from tests.support.exported import make_snapshot, write
from tests.support.synthetic import photographs


@pytest.fixture
def folder(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    for frame in photographs():
        (images / frame.name).write_bytes(encode_png(frame.image))
    return images


def test_a_folder_becomes_a_map(folder, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["replay", str(folder), "--map", "--preset", "fast", "--size", "320", "--out", str(out)]
    assert command_line.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "6 of 6 photographs are keyframes" in printed and "6 of 6 keyframes are in a map" in printed
    assert "OK: One scene of 1: scene-0001." in printed
    report = json.loads((out / "report.json").read_text())
    assert report["keyframes_in_a_map"] == 6 and report["left_out"] == [] and list(report["maps"]) == ["map-scene-0001"]
    assert len(read_cameras(out / "map-scene-0001" / "cameras.json")) == 6
    assert (out / "map-scene-0001" / "levels.json").exists() and not (out / "checkpoint").exists()

    assert command_line.main(arguments) == 2
    assert "holds the scenes of a map already; give another --out" in capsys.readouterr().err


def test_what_is_about_one_scene_does_not_go_with_a_map(folder, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["replay", str(folder), "--map", "--views", "3", "--budget-s", "9", "--out", str(out)]
    assert command_line.main(arguments) == 2
    assert "does not go with what is about one: --views, --budget-s" in capsys.readouterr().err and not out.exists()


@pytest.mark.parametrize("further", [[], ["--map"]])
def test_a_frame_that_nothing_tells_is_a_usage_error_before_the_work(folder, tmp_path, capsys, further):
    out = tmp_path / "out"
    arguments = ["replay", str(folder), "--frame", "base", *further, "--out", str(out)]
    assert command_line.main(arguments) == 2
    assert "no image tells where its camera stands on the robot's base. Give T_base_camera" in capsys.readouterr().err
    assert not out.exists() or not any(out.iterdir())


def test_gravity_of_the_first_image_is_that_of_no_other_scene(folder, tmp_path, capsys):
    arguments = ["replay", str(folder), "--map", "--gravity", "0,1,0", "--out", str(tmp_path / "out")]
    assert command_line.main(arguments) == 2
    assert "does not go with what is about one: --gravity" in capsys.readouterr().err


def test_what_makes_no_scene_is_told(folder, tmp_path, capsys):
    for path in sorted(folder.iterdir())[1:]:
        path.unlink()
    out = tmp_path / "out"
    write(make_snapshot(), out)  # of one scene: beside it nobody would find the map's
    export_scene(out, "spz")
    assert command_line.main(["replay", str(folder), "--map", "--out", str(out)]) == 65
    assert not any((out / name).exists() for name in ("scene.ply", "scene.spz", "cameras.json", "exports.json"))
    report = json.loads((out / "report.json").read_text())
    assert report["maps"] == {} and report["keyframes_in_a_map"] == 0
    (left_out,) = report["left_out"]
    assert "TOO_FEW_VIEWS" in left_out["reason"]
    assert "left out: " in capsys.readouterr().out
