"""`splatnode calibrate`, from photographs and from a camera to the file that other verbs read."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from splatnode import command_line
from splatnode.capture import lenses
from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, make_frame
from splatnode.capture.lenses import read_lens
from splatnode.capture.reader import Config, Reader
from splatnode.capture.recording import Recorder
from splatnode.extras.calibration import collect
from splatnode.extras.calibration.board import Board
from splatnode.extras.calibration.collect import Limits
from tests.support import mcap_files
from tests.support.board_photographs import Conditions, Photographer, parallel, waved
from tests.support.fake_camera import fake_camera

BOARD = Board()
LENS = Intrinsics(640, 480, 600.0, 600.0, 324.0, 237.0, "given", (-0.2, 0.03, 0.0, 0.0))
CORNERS = np.array([[0.0, 0.0], [640.0, 0.0], [0.0, 480.0], [640.0, 480.0]])

CAMERA = '''
"""Shows photographs, each for two frames, again and again."""

import time
from pathlib import Path

import cv2
import msgspec

from splatnode.capture.frame import Frame

LIVE = True


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    folder: Path


def stream(config):
    images = [cv2.imread(str(path)) for path in sorted(config.folder.glob("*.png"))]
    for index in range(10**9):
        yield Frame(index, f"{index}.png", time.monotonic_ns(), images[index // 2 % len(images)], None)
'''


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("photographs")
    photographer = Photographer(BOARD, LENS, Conditions(noise=1.0))
    for number, T in enumerate(waved(BOARD, LENS, 24, 1)):
        cv2.imwrite(str(where / f"{number:02d}.png"), photographer.photograph(T, number))
    return where


def error_px(lens: Intrinsics) -> float:
    found = lenses.project(lenses.unproject(CORNERS, LENS), lens)
    return float(np.linalg.norm(found - CORNERS, axis=1).max())


def test_photographs_give_a_lens_that_the_other_verbs_read(photographs, tmp_path, capsys):
    out = tmp_path / "lens.yaml"
    assert command_line.main(["calibrate", str(photographs), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "opencv2 (OpenCV's radial terms k1 k2) from 24 views" in said and "|##########|" in said
    lens = read_lens(out)
    assert lens.source == "calibration" and abs(lens.fx / LENS.fx - 1) < 0.002 and error_px(lens) < 0.8
    report = yaml.safe_load(out.read_text())["calibration"]
    assert report["views"] == 24 and report["held_out_px"]["opencv2"] < 0.1 < report["held_out_px"]["pinhole"]
    assert 0 < report["corner_sigma_px"]["upper left"] < 0.5 and 0 < report["sigma"]["fx"] < 1
    assert len(report["covered"]) == 8
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump({"camera": {"kind": "folder", "folder": str(photographs)}}))
    record = ["record", str(tmp_path / "camera.yaml"), "--out", str(tmp_path / "again"), "--intrinsics", str(out)]
    assert command_line.main(record) == 0
    (first, *_) = folder.stream(folder.Config(tmp_path / "again"))
    assert isinstance(first, Frame) and first.intrinsics == lens


def every_frame(opened: Callable[[], Iterator[Frame | DroppedFrame]], live: bool, config: Config) -> Reader:
    """A reader that leaves none out, however slow the test's machine is."""
    assert live
    return Reader(opened, False, config)


def test_a_camera_is_watched_until_the_lens_is_known(photographs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(collect, "GOOD", Limits(focal=0.002, corner=0.0008))
    monkeypatch.setattr(collect, "Reader", every_frame)
    with fake_camera("showing", CAMERA, tmp_path, monkeypatch) as config:
        arguments = [str(config), "--set", f"camera.folder={photographs}", "--model", "opencv2"]
        assert command_line.main(["calibrate", *arguments, "--out", str(tmp_path / "lens.yaml")]) == 0
    said = capsys.readouterr().out
    assert said.count("the picture: #") >= 3  # it grew while it was shown
    assert error_px(read_lens(tmp_path / "lens.yaml")) < 1.0


def refusal(capsys: pytest.CaptureFixture, *arguments: object) -> tuple[int, str]:
    code = command_line.main(["calibrate", *map(str, arguments)])
    return code, re.sub(r"\s+", " ", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["--dictionary", "6X6_250"],
            "the board has markers of 5X5, not of 6X6_250: give --dictionary, such as 5X5_250",
        ),
        (
            ["--columns", "8", "--rows", "5"],
            "markers of 5X5_100 up to number 34, and a board of 8 x 5 squares has them up",
        ),
        (["--columns", "12", "--rows", "9"], "do not lie as on a board of 12 x 9 squares"),
    ],
)
def test_another_board_is_named(photographs, tmp_path, capsys, arguments, said):
    some = copied(photographs, tmp_path, 3)
    code, told = refusal(capsys, some, "--out", tmp_path / "lens.yaml", *arguments)
    assert code == 65 and said in told
    assert not (tmp_path / "lens.yaml").exists()


def copied(photographs: Path, where: Path, count: int) -> Path:
    (where / "some").mkdir()
    for path in sorted(photographs.glob("*.png"))[:count]:
        (where / "some" / path.name).write_bytes(path.read_bytes())
    return where / "some"


def test_mirrored_photographs_are_named(photographs, tmp_path, capsys):
    some = copied(photographs, tmp_path, 2)
    for path in some.iterdir():
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path)), 1))
    code, told = refusal(capsys, some, "--out", tmp_path / "lens.yaml")
    assert code == 65 and "the pictures are mirrored" in told


def test_too_few_photographs_are_refused_with_all_that_is_missing(photographs, tmp_path, capsys):
    code, told = refusal(capsys, copied(photographs, tmp_path, 3), "--out", tmp_path / "lens.yaml")
    assert code == 65 and "10 pictures that show the board are needed; 3 of 3 show it" in told
    assert "the board was never seen near the picture's corner" in told


def as_mcap(images: list[np.ndarray], where: Path) -> Path:
    mcap_files.write(where / "drive.mcap", [mcap_files.compressed("/front/image", image) for image in images])
    return where / "drive.mcap#" / "front" / "image"


def as_recording(images: list[np.ndarray], where: Path) -> Path:
    with Recorder(where / "recording") as recorder:
        for number, image in enumerate(images):
            recorder.write(make_frame(number, f"{number}.png", number + 1, image, None))
    return where / "recording"


@pytest.mark.parametrize("recorded", [as_mcap, as_recording])
def test_of_what_a_robot_recorded_only_views_of_a_board_at_rest_are_taken(photographs, tmp_path, capsys, recorded):
    moving = [cv2.imread(str(path))[..., ::-1] for path in sorted(photographs.glob("*.png"))[:4]]
    source = recorded([*moving, moving[3]], tmp_path)
    code, told = refusal(capsys, source, "--out", tmp_path / "lens.yaml")
    assert code == 65 and "1 of 5 shows it, from a place and at a tilt of its own, held still for a moment" in told


def test_a_film_is_named_as_for_replay(tmp_path, capsys):
    data_set, film = tmp_path / "set", tmp_path / "film.mp4"
    (data_set / "meta").mkdir(parents=True)
    (data_set / "meta" / "info.json").write_text("{}")
    film.write_bytes(b"")
    camera = collect._config(tmp_path / "set#3" / "observation.images.top", []).camera
    assert (camera.kind, camera.config.folder, camera.config.part) == ("lerobot", data_set, "3/observation.images.top")
    assert collect._is_moving(camera) and collect._is_moving(collect._config(film, []).camera)
    assert not collect._is_moving(collect._config(tmp_path, []).camera)
    code, told = refusal(capsys, tmp_path / "film.mp4#3", "--out", tmp_path / "lens.yaml")
    assert code == 2 and "behind the # must be seconds of the video" in told


def test_photographs_without_the_board_are_refused(tmp_path, capsys):
    (tmp_path / "some").mkdir()
    cv2.imwrite(str(tmp_path / "some" / "a.png"), np.full((480, 640, 3), 90, np.uint8))
    code, told = refusal(capsys, tmp_path / "some", "--out", tmp_path / "lens.yaml")
    assert code == 65 and "none of 1 pictures shows the board (10 x 7 squares with markers of 5X5_100)" in told


def test_a_board_that_is_always_parallel_to_the_picture_is_refused(tmp_path, capsys):
    (tmp_path / "some").mkdir()
    lens = Intrinsics(640, 480, 600.0, 600.0, 324.0, 237.0, "given")
    photographer = Photographer(BOARD, lens)
    for number, T in enumerate(parallel(BOARD, lens, 12, 1)):
        cv2.imwrite(str(tmp_path / "some" / f"{number}.png"), photographer.photograph(T, number))
    code, told = refusal(capsys, tmp_path / "some", "--out", tmp_path / "lens.yaml", "--model", "pinhole")
    assert code == 65 and "the focal length is known to" in told and "Tilt it by 20 to 45 degrees" in told


def test_photographs_of_two_sizes_are_refused(photographs, tmp_path, capsys):
    some = copied(photographs, tmp_path, 2)
    cv2.imwrite(str(some / "99.png"), np.full((640, 480, 3), 90, np.uint8))
    code, told = refusal(capsys, some, "--out", tmp_path / "lens.yaml")
    assert code == 65 and "00.png has 640 x 480 pixels, 99.png has 480 x 640" in told


def test_what_cannot_be_asked_for_is_refused(photographs, tmp_path, capsys):
    out, there = tmp_path / "lens.yaml", tmp_path / "there.yaml"
    there.write_text("")
    cases = {
        "give a camera's configuration, a folder": [photographs],
        "is there already": [photographs, "--out", there],
        "there is no folder": [photographs, "--out", tmp_path / "none" / "lens.yaml"],
        "is one photograph; give the folder": [photographs / "00.png", "--out", out],
        "not both": [photographs, "--board", tmp_path / "board.pdf"],
        "smaller than its square of 20 mm": ["--board", tmp_path / "board.pdf", "--square-mm", 20, "--marker-mm", 25],
        "has no room for it": ["--board", tmp_path / "board.pdf", "--square-mm", 40],
    }
    for said, arguments in cases.items():
        code, told = refusal(capsys, *arguments)
        assert code == 2 and said in told


def test_the_board_is_written(tmp_path, capsys):
    assert command_line.main(["calibrate", "--board", str(tmp_path / "board.pdf"), "--paper", "letter"]) == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF-1.6")
    assert "print it at 100 % on letter" in capsys.readouterr().out
