"""An audit over the episodes of a LeRobot data set, and over MCAP files, made by the formats' own libraries."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.command_line import main
from tests.support import lerobot_sets
from tests.support.located import PLACE, turned
from tests.support.mcap_files import calibration, compressed, write

pq = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
pa = pytest.importorskip("pyarrow", reason="needs pyarrow")

LEFT, *_, RIGHT = synthetic.evaluation_cameras(PLACE)


@lru_cache
def seen(name: str, degrees: float, seed: int) -> np.ndarray:
    """What a camera of the station sees, once it has turned by so much."""
    return synthetic.render_image(PLACE, turned({"left": LEFT, "right": RIGHT}[name], degrees), seed)


def episode(left_turned_deg: float, seed: int) -> dict[str, list[np.ndarray]]:
    return {"left": [seen("left", left_turned_deg, seed)] * 2, "right": [seen("right", 0.0, seed)] * 2}


def without_images(data_set: Path, number: int, key: str) -> None:
    """Takes a camera's images from an episode's row."""
    file = data_set / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    rows = pq.read_table(file).to_pylist()
    rows[number][f"videos/{key}/from_timestamp"] = None
    pq.write_table(pa.Table.from_pylist(rows), file)


def test_the_camera_that_moved_between_two_episodes_is_named_and_the_other_is_not(result, tmp_path, capsys):
    station = tmp_path / "station"
    data_set = lerobot_sets.write(station / "pusht", [episode(0.0, 1), episode(0.0, 2), episode(2.0, 3)])
    without_images(data_set, 1, "right")
    lerobot_sets.write(station / "older", [episode(0.0, 1)], codebase_version="v2.1")
    told, drawn = tmp_path / "audit.json", tmp_path / "audit.svg"
    assert main(["audit", str(result), str(station), "--json", str(told), "--picture", str(drawn)]) == 0
    out = capsys.readouterr().out
    assert "left moved between episode_000001 and episode_000002 by 2 degrees" in out.replace("2.0 ", "2 ")
    assert "right stood still in 2 recordings" in out and out.count("moved between") == 1
    assert "right was not compared in episode_000001: UNREADABLE:" in out and "episode 1 has no images of right" in out
    assert "older was not compared:" in out and "it is of v2.1" in out
    values = json.loads(told.read_text())
    assert values["moves"] == [{"after": "episode_000001", "before": "episode_000002", "cameras": ["left"]}]
    assert [each["recording"] for each in values["not_read"]] == ["older"]
    assert list(values["cameras"]) == ["left", "right"]
    assert "left" in drawn.read_text() and "episode_000002" in drawn.read_text()


def test_the_camera_that_moved_between_two_logs_is_named_and_the_other_is_not(result, tmp_path, capsys):
    K = RIGHT[1]
    for day, degrees in enumerate((0.0, 2.0)):
        told = [
            compressed("/left/image", seen("left", degrees, day)),
            compressed("/right/image", seen("right", 0.0, day)),
            calibration(
                "/right/camera_info", (PLACE.width, PLACE.height), (K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).ravel()
            ),
        ]
        write(tmp_path / f"day{day}.mcap", told)
    assert main(["audit", str(result), str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "/left/image moved between day0.mcap and day1.mcap by 2 degrees" in out.replace("2.0 ", "2 ")
    assert "/right/image stood still in 2 recordings" in out
    assert "1 of 2 cameras moved in 2 recordings; 2 could be compared" in out


def test_a_lens_that_cannot_be_undone_costs_only_its_camera(result, tmp_path, capsys):
    for day in range(2):
        told = [compressed("/left/image", seen("left", 0.0, day)), compressed("/right/image", seen("right", 0.0, day))]
        lens = calibration("/right/camera_info", (PLACE.width, PLACE.height), RIGHT[1].ravel(), D=(-3.0, 0, 0, 0, 0))
        write(tmp_path / f"day{day}.mcap", [*told, lens])
    assert main(["audit", str(result), str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "/left/image stood still in 2 recordings" in out and "photograph:" not in out
    assert "/right/image was not compared in day0.mcap: UNREADABLE: " in out
    assert "folds the picture over" in out and "1 could be compared" in out
