"""splatnode audit: what moved between recordings of a station, in lines, JSON and a picture."""

from __future__ import annotations

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Camera
from splatnode.capture.image_file import encode_png
from splatnode.command_line import main
from tests.support.located import PLACE, turned


def picture(camera: Camera, seed: int) -> bytes:
    return encode_png(synthetic.render_image(PLACE, camera, seed))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two cameras: the left one is turned before the third recording, the right one sees nothing in the second."""
    folder, (left, *_, right) = tmp_path_factory.mktemp("station"), synthetic.evaluation_cameras(PLACE)
    visits = [folder / day for day in ("monday", "tuesday", "wednesday")]
    for day, visit in enumerate(visits):
        visit.mkdir()
        (visit / "left.png").write_bytes(picture(turned(left, 1.0 if day == 2 else 0.0), 10 + day))
        hidden = encode_png(np.full((PLACE.height, PLACE.width, 3), 90, np.uint8))
        (visit / "right.png").write_bytes(hidden if day == 1 else picture(right, 20 + day))
    return visits


def test_the_camera_that_moved_is_named_with_when_and_by_how_much(result, recordings, tmp_path, capsys):
    told, drawn = tmp_path / "audit.json", tmp_path / "audit.svg"
    files = ["--json", str(told), "--picture", str(drawn)]
    assert main(["audit", str(result), *map(str, recordings), *files]) == 0
    out = capsys.readouterr().out
    assert out.startswith("3 recordings, monday to wednesday, of 2 cameras: left, right\n")
    assert "left moved between tuesday and wednesday by 1 degrees" in out.replace("0.99 ", "1 ").replace("1.0 ", "1 ")
    assert "right stood still in 2 recordings" in out and "right was not compared in tuesday: NOT_FOUND" in out
    assert "1 of 2 cameras moved in 3 recordings; 2 could be compared" in out
    values = json.loads(told.read_text())
    assert values["moves"] == [{"after": "tuesday", "before": "wednesday", "cameras": ["left"]}]
    first, second = values["cameras"]["left"]["periods"]
    assert first["recordings"] == ["monday", "tuesday"] and second["recordings"] == ["wednesday"]
    assert second["came_by"]["turn_deg"] == pytest.approx(1.0, abs=0.1) and second["came_by"]["shift"] < 0.01
    assert first["noticed_from"]["turn_deg"] < 0.3 and first["noticed_from"]["shift"] < 0.005
    cells = [each for each in ElementTree.parse(drawn).iter() if each.tag.endswith("rect") and len(each)]
    assert len(cells) == 6 and len({cell.get("fill") for cell in cells}) == 3


def test_a_camera_that_moves_within_a_recording_is_not_compared(result, tmp_path, capsys):
    left, *_ = synthetic.evaluation_cameras(PLACE)
    shifted = left[0].copy(), left[1]
    shifted[0][:3, 3] += 0.05 * left[0][:3, 0]
    for day, later in (("monday", turned(left, 2.0)), ("tuesday", shifted)):
        (tmp_path / day / "wrist").mkdir(parents=True)
        for index, camera in enumerate((left, later)):
            (tmp_path / day / "wrist" / f"{index}.png").write_bytes(picture(camera, index))
    assert main(["audit", str(result), str(tmp_path / "monday"), str(tmp_path / "tuesday")]) == 65
    out = capsys.readouterr().out
    assert "wrist was not compared in monday: MOVING: since 0.png it moved by 2 degrees (±" in out
    shift = re.search(r"tuesday: MOVING: since 0.png it moved by \S+ degrees .* and (\S+) % of the distance", out)
    assert shift is not None and float(shift[1]) > 0.5, out
    assert "0 of 1 cameras moved in 2 recordings; 0 could be compared" in out


def test_a_lens_that_can_be_of_no_camera_is_told_before_the_work(result, recordings, tmp_path, capsys):
    lens = tmp_path / "lens.yaml"
    lens.write_text("{width: 100, height: 100, fx: 90, fy: 90, cx: 50, cy: 50}")
    film = tmp_path / "film" / "left.mp4"
    film.parent.mkdir()
    film.write_bytes(b"no video")
    visits = [str(film.parent), *map(str, recordings)]
    assert main(["audit", str(result), *visits, "--intrinsics", str(lens)]) == 2
    told = capsys.readouterr()
    assert "got those of 100 x 100 for 480 x 360" in told.err and not told.out


def test_mistakes_are_told_in_a_sentence(result, recordings, tmp_path, capsys):
    empty = tmp_path / "empty"
    empty.mkdir()
    for arguments, expected in (
        ((result, recordings[0], recordings[0]), "is given twice"),
        ((result, tmp_path / "nowhere"), "is not there; give a folder, a video, an MCAP file, a data set, or a list"),
        ((result, empty), "no photographs"),
        ((empty, recordings[0]), "is not a result of splatnode"),
    ):
        assert main(["audit", *map(str, arguments)]) == 2
        assert expected in capsys.readouterr().err


def test_recordings_of_one_name_are_told_apart(result, recordings, tmp_path, capsys):
    for station in ("a", "b"):
        (tmp_path / station).mkdir()
        (tmp_path / station / "monday").symlink_to(recordings[0])
    assert main(["audit", str(result), *(str(tmp_path / station / "monday") for station in ("a", "b"))]) == 0
    assert "left stood still in 2 recordings" in capsys.readouterr().out
