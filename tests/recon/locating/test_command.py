"""splatnode locate: a line a photograph, an exit code, and a file for programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.image_file import encode_png
from splatnode.capture.recording import Recorder
from splatnode.command_line import main
from splatnode.recon.locating.localize import stream_query_frames as named
from splatnode.recon.result.export.stored import encode_cameras
from splatnode.recon.result.stored_snapshot import LANDMARKS, encode_landmarks
from splatnode.recon.result.verdict import FrameName, ReferenceFrame, Scale
from tests.support.located import PLACE, known_place, photograph


@pytest.fixture
def result(tmp_path: Path) -> Path:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / LANDMARKS).write_bytes(encode_landmarks(known_place().landmarks))
    return folder


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for index in (0, 3):
        (folder / f"{index}.png").write_bytes(encode_png(photograph(index)[0]))
    return folder


def test_a_folder_of_photographs_is_placed(result, photographs, tmp_path, capsys):
    found = tmp_path / "found.json"
    assert main(["locate", str(result), str(photographs), "--json", str(found)]) == 0
    out = capsys.readouterr().out
    assert "0.png: placed at (" in out and "3.png: placed at (" in out and "2 of 2 photographs were placed" in out
    told = json.loads(found.read_text())
    assert (told["unit"], told["frame"]) == ("relative", None)  # without cameras.json nobody tells the frame
    assert told["scale"] == "relative" and [each["name"] for each in told["photographs"]] == ["0.png", "3.png"]
    frame = ReferenceFrame(FrameName.BASE, "T_base_camera of 0.png")
    (result / "cameras.json").write_bytes(encode_cameras((), Scale(True, "a marker", None, frame)))
    assert main(["locate", str(result), str(photographs / "0.png"), "--json", str(found)]) == 0
    assert json.loads(found.read_text())["frame"] == "base"
    first = told["photographs"][0]
    assert first["placed"] and np.shape(first["T_world_camera"]) == (4, 4) and np.shape(first["covariance"]) == (6, 6)
    assert first["width"] == PLACE.width and first["claim"]["rotation_deg"] > 0 and first["points"] > 100
    assert first["lens"] == "scene" and len(first["distortion"]) == 2 and first["claim"]["principal_percent"] > 0


def test_one_that_is_refused_is_told_with_its_reason_and_the_exit_code(result, photographs, tmp_path, capsys):
    plain = tmp_path / "plain.png"
    plain.write_bytes(encode_png(np.full((90, 120, 3), 128, np.uint8)))
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    found = tmp_path / "found.json"
    images = [str(photographs / "0.png"), str(plain), str(broken)]
    assert main(["locate", str(result), *images, "--json", str(found)]) == 65
    out = capsys.readouterr().out
    assert "plain.png: refused: NOT_FOUND" in out and "broken.png: left out" in out and "1 of 3" in out
    codes = [each.get("code") for each in json.loads(found.read_text())["photographs"]]
    assert codes == [None, "NOT_FOUND", "UNREADABLE"]


def test_a_lens_can_be_given(result, photographs, tmp_path, capsys):
    K = photograph(0)[1][1]
    lens = tmp_path / "lens.yaml"
    lens.write_text(
        f"intrinsics: {{width: {PLACE.width}, height: {PLACE.height}, "
        f"fx: {K[0, 0]}, fy: {K[1, 1]}, cx: {K[0, 2]}, cy: {K[1, 2]}}}"
    )
    assert main(["locate", str(result), str(photographs), "--intrinsics", str(lens)]) == 0
    degrees = str(float(np.degrees(2 * np.arctan(PLACE.width / 2 / K[0, 0]))))
    assert main(["locate", str(result), str(photographs), "--fov", degrees]) == 0
    assert main(["locate", str(result), str(photographs), "--fov", "9"]) == 65
    lens.write_text("fx: 3")
    capsys.readouterr()
    assert main(["locate", str(result), str(photographs), "--intrinsics", str(lens)]) == 2
    assert "must give width, height, fx" in capsys.readouterr().err


def test_a_lens_that_cannot_be_undone_costs_only_its_photograph(result, photographs, tmp_path, capsys):
    folding = Intrinsics(PLACE.width, PLACE.height, 400, 400, 240, 180, "calibration", (-3.0, 0, 0, 0))
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(Frame(0, "bent.png", 0, photograph(0)[0], folding))
    found = tmp_path / "found.json"
    images = [str(tmp_path / "recorded"), str(photographs / "0.png")]
    assert main(["locate", str(result), *images, "--json", str(found)]) == 65
    out = capsys.readouterr().out
    assert "bent.png: left out: distortion" in out and "1 of 2 photographs were placed" in out
    assert [each.get("code") for each in json.loads(found.read_text())["photographs"]] == ["UNREADABLE", None]


def test_a_lens_that_can_be_of_no_photograph_is_told_before_the_work(result, photographs, tmp_path, capsys):
    lens = tmp_path / "lens.yaml"
    lens.write_text("{width: 100, height: 100, fx: 90, fy: 90, cx: 50, cy: 50}")
    given = ["--intrinsics", str(lens)]
    assert main(["locate", str(result), str(photographs), *given]) == 2
    told = capsys.readouterr()
    assert "got those of 100 x 100 for 480 x 360" in told.err and not told.out
    (photographs / "plain.png").write_bytes(encode_png(np.full((90, 90, 3), 128, np.uint8)))
    assert main(["locate", str(result), str(photographs), *given]) == 65
    assert "the lens was not given to 2 of them" in capsys.readouterr().out
    lens.write_text(f"{{width: {PLACE.width}, height: {PLACE.height}, fx: 400, fy: 400, cx: 240, cy: 180, "
                    "distortion: [-3, 0, 0, 0]}")  # fmt: skip
    assert main(["locate", str(result), str(photographs), *given]) == 2
    told = capsys.readouterr()
    assert "0.png: distortion" in told.err and not told.out


def test_a_lens_that_is_given_is_that_of_a_recording_too(tmp_path):
    lens = Intrinsics(PLACE.width, PLACE.height, 400, 400, 240, 180, "given")
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(Frame(0, "a.png", 0, photograph(0)[0], None))
    (frame,) = named([tmp_path / "recorded"], lens)
    assert isinstance(frame, Frame) and frame.intrinsics == lens


def test_what_is_not_there_is_said(result, photographs, tmp_path, capsys):
    for arguments in ([tmp_path / "nowhere", photographs], [result, tmp_path / "nowhere.png"]):
        assert main(["locate", *map(str, arguments)]) == 2
        assert "nowhere" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["locate", str(result), str(photographs), "--fov", "200"])
