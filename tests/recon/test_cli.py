"""`splatnode replay`: what it refuses before it begins, and what it leaves behind where the answer is no."""

from __future__ import annotations

import argparse
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from splatnode import command_line
from splatnode.capture.cameras.folder import Config, stream
from splatnode.capture.recording import Recorder
from splatnode.recon import cli, pipeline, replay_source
from splatnode.recon.result.verdict import Scale
from tests.support.exported import make_snapshot


@pytest.fixture
def photographs(tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(folder / name), picture)
    return folder


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--out", "new", "--baseline", "a.png", "c.png", "0.5"], 2, "'c.png' is not among those that are used: a.png"),
        (["--out", "new", "--baseline", "a.png", "b.png", "far"], 2, "a distance in metres, got 'far'"),
        (["--out", "new", "--stereo", "photographs"], 2, "--stereo and --stereo-baseline belong together"),
        (["--out", "new", "--stereo", "gone", "--stereo-baseline", "75mm"], 2, "'gone' is not there"),
        (["--out", "new", "--poses", "gone.tum"], 2, "gone.tum is not there; give a TUM"),
        (["--out", "new", "--poses-sigma", "0.1,5"], 2, "--poses-sigma is of --poses"),
        (["--out", "new", "--check-poses"], 2, "--check-poses is of --poses"),
        (["--out", "new", "--poses", "photographs"], 2, "must hold images.txt or images.bin"),
        (["--out", "new", "--poses", "photographs/a.png"], 2, "must be a TUM trajectory"),
        (["--out", "new", "--map", "--marker", "100mm"], 2, "does not go with what is about one: --marker"),
        (["--out", "new/../photographs"], 2, "must not be the folder of the photographs"),
        (["--out", "photographs/a.png"], 73, "choose another folder"),
        (["--out", "photographs/a.png/below"], 73, "choose another folder"),
    ],
)
def test_what_cannot_end_well_is_not_begun(photographs, monkeypatch, capsys, arguments, code, said):
    monkeypatch.chdir(photographs.parent)
    monkeypatch.setattr(pipeline, "reconstruct", lambda *_: pytest.fail("was begun"))
    assert command_line.main(["replay", "photographs", *arguments]) == code
    assert said in capsys.readouterr().err
    assert {path.name for path in photographs.parent.iterdir()} == {"photographs"}
    assert {path.name for path in photographs.iterdir()} == {"a.png", "b.png"}


def test_a_folder_with_the_scenes_of_a_map_is_not_written_into(photographs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pipeline, "reconstruct", lambda *_: pytest.fail("was begun"))
    out = tmp_path / "walk"
    out.mkdir()
    (out / "places.json").write_text("{}")
    assert command_line.main(["replay", str(photographs), "--out", str(out)]) == 2
    assert "walk holds the scenes of a map or of a node (places.json); give another --out" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["places.json"]


def test_the_picture_that_an_earlier_run_showed_is_removed_and_others_stay(tmp_path):
    pictures = tmp_path / "view"
    pictures.mkdir()
    for name in ("live.png", "mine.png"):
        (pictures / name).write_bytes(b"a picture")
    with cli._viewer(argparse.Namespace(out=tmp_path, view=False)) as show:
        assert show is pipeline.ignore_snapshot
    assert [path.name for path in pictures.iterdir()] == ["mine.png"]


def test_a_baseline_of_a_photograph_that_was_not_chosen_says_so(photographs, monkeypatch, capsys):
    monkeypatch.chdir(photographs.parent)
    monkeypatch.setattr(replay_source, "ALL", 1)  # so that keyframes are chosen, and b.png is a copy
    code = command_line.main(["replay", "photographs", "--out", "new", "--baseline", "a.png", "b.png", "0.5"])
    said = capsys.readouterr().err
    assert code == 2 and "'b.png' is not among those that were chosen: a.png." in said and "--every-frame" in said


def test_so_many_views_of_a_recording_go_by_the_names_that_its_frames_had(photographs, capsys):
    recording, out = photographs.parent / "recording", photographs.parent / "out"
    with Recorder(recording) as recorder:
        for frame in stream(Config(folder=photographs)):
            recorder.write(frame)
    assert command_line.main(["replay", str(recording), "--views", "1", "--out", str(out)]) == 65
    assert json.loads((out / "report.json").read_text())["verdict"]["code"] == "TOO_FEW_VIEWS"


def test_a_refusal_leaves_a_report_that_says_why(photographs, capsys):
    out = photographs.parent / "out"
    assert command_line.main(["replay", str(photographs), "--out", str(out)]) == 65
    assert {path.name for path in out.iterdir()} == {"report.json", "manifest.json"}
    verdict = json.loads((out / "report.json").read_text())["verdict"]
    assert verdict["code"] == "STATIC_CAMERA"
    assert capsys.readouterr().out.startswith(f"STATIC_CAMERA: {verdict['message']}")


@pytest.fixture
def replayed(photographs, monkeypatch):
    """Replays the photographs into new/out, where `instead` is done in place of the reconstruction."""

    def replay(instead) -> int:
        monkeypatch.chdir(photographs.parent)
        monkeypatch.setattr(pipeline, "reconstruct", lambda *_: instead())
        return command_line.main(["replay", "photographs", "--out", "new/out"])

    return replay


def test_the_terminal_tells_how_well_the_cameras_are_known(replayed, capsys):
    images = {camera.name: np.zeros((384, 512, 3), np.uint8) for camera in make_snapshot().cameras}
    found = replace(make_snapshot(), images=images, seconds={"total": 3.5}, scale=Scale(True, "a ruler"))
    assert replayed(lambda: [found]) == 0
    known = "directions to 0.1 degrees, positions to 2 % of the distance to the scene (2 cm), focal length to 1.5 %"
    assert f"\nhow well the cameras are known: {known} (95 % bounds)\nlengths: metric (metres: a ruler)\n" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (SystemExit(0), None), (OSError(5, "x"), 74)])
def test_a_replay_that_is_interrupted_leaves_no_empty_folder(replayed, photographs, error, code):
    def interrupted():
        assert Path("new/out").is_dir()
        raise error

    if code is None:
        with pytest.raises(SystemExit):
            replayed(interrupted)
    else:
        assert replayed(interrupted) == code
    assert {path.name for path in photographs.parent.iterdir()} == {"photographs"}


def test_a_replay_that_is_interrupted_leaves_what_was_there_before_and_what_was_written(replayed, photographs):
    def interrupted():
        Path("new/out/kept.txt").write_text("mine")
        raise KeyboardInterrupt

    assert replayed(interrupted) == 130
    assert [path.name for path in (photographs.parent / "new" / "out").iterdir()] == ["kept.txt"]
    (photographs.parent / "new" / "out" / "kept.txt").unlink()
    assert replayed(lambda: (_ for _ in ()).throw(KeyboardInterrupt)) == 130
    assert (photographs.parent / "new" / "out").is_dir()


def test_two_replays_into_one_folder_refuse_each_other(replayed, capsys):
    def again():
        code = command_line.main(["replay", "photographs", "--out", "new/out"])
        assert code == 75 and f"process {os.getpid()} writes its results into new/out" in capsys.readouterr().err
        raise KeyboardInterrupt

    assert replayed(again) == 130
    assert not Path("new").exists()


def test_a_nearly_full_disk_is_told_before_the_work(replayed, monkeypatch, capsys):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=10**9, free=1_500_000))
    assert replayed(lambda: pytest.fail("was begun")) == 74
    said = capsys.readouterr().err
    assert "1.5 MB are free in new/out, and the result may take 9.0 MB. Free some space" in said
    assert command_line.main(["demo", "--out", "new/out"]) == 74
    assert "the result may take" in capsys.readouterr().err
    assert not Path("new").exists()


def test_where_keyframes_were_thinned_out_the_map_is_named(photographs, monkeypatch, capsys):
    monkeypatch.setattr(replay_source, "ALL", 1)
    monkeypatch.setattr(replay_source, "MOST", 1)
    rng = np.random.default_rng(1)
    for name in ("c.png", "d.png"):
        cv2.imwrite(str(photographs / name), rng.integers(0, 256, (48, 64, 3)).astype(np.uint8))
    out = photographs.parent / "out"
    assert command_line.main(["replay", str(photographs), "--out", str(out)]) == 65
    assert "thinned out" in (printed := capsys.readouterr().out) and "--map uses the keyframes" in printed
