"""Bad recordings beside a good one, through the command itself: each has its sentence, and the rest goes on."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode import command_line
from splatnode.extras.batch import FAILED
from splatnode.extras.batch.command import EXIT_SOME_FAILED
from tests.support import lerobot_sets
from tests.support.synthetic import photographs

pq = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")

PICTURES = [np.zeros((48, 64, 3), np.uint8)] * 2
SENTENCES = {
    "older": "must be a LeRobot data set of version v3.0, it is of v2.1; convert it with LeRobot's",
    "empty_episode_000000_top": "episode 0 has no images of top",
    "torn": "torn.mp4' is no video that can be decoded, or has no frame",
    "broken": "broken.mcap' is no MCAP file that is whole",
}


def with_an_empty_episode(data_set: Path) -> None:
    """Its images end where they begin."""
    file = data_set / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(file)
    row = {**table.to_pylist()[0], "videos/top/to_timestamp": 0.0}
    pq.write_table(table.from_pylist([row], schema=table.schema), file)


def test_each_has_its_sentence_and_the_rest_goes_on(tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    lerobot_sets.write(folder / "older", [{"top": PICTURES}], codebase_version="v2.1")
    with_an_empty_episode(lerobot_sets.write(folder / "empty", [{"top": PICTURES}]))
    (folder / "torn.mp4").write_bytes(b"no video")
    (folder / "broken.mcap").write_bytes(b"no log")
    (folder / "place").mkdir()
    frame = photographs()[0]
    cv2.imwrite(str(folder / "place" / frame.name), frame.image[:, :, ::-1])
    argv = ["batch", str(folder), "--out", str(out), "--preset", "preview", "--cores", "1"]
    assert command_line.main(argv) == EXIT_SOME_FAILED
    with (out / "batch.csv").open(newline="", encoding="utf-8") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert rows.pop("place")["verdict"] == "TOO_FEW_VIEWS", "it has its answer"
    assert set(rows) == set(SENTENCES)
    for name, row in rows.items():
        assert row["verdict"] == FAILED and SENTENCES[name] in row["message"]
