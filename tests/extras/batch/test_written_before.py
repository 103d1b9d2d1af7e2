"""Cameras written back in several batches: each leaves what the ones before wrote of other recordings."""

from __future__ import annotations

import errno
import re
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from splatnode.capture import film
from splatnode.extras.batch import recordings
from splatnode.extras.batch.command import EXIT_GOOD, EXIT_SOME_FAILED, run_batch
from tests.extras.batch.test_write_back import PICTURE, data_set, drive, placed  # noqa: F401  fixtures
from tests.support import mcap_files
from tests.support.recordings import options

pa = pytest.importorskip("pyarrow", reason="needs pyarrow")
pq = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")

TABLE = Path("meta", "splatnode_cameras.parquet")
EPISODES = Path("meta", "episodes", "chunk-000", "file-000.parquet")


def ran(tmp_path: Path, file: Path, *parts: str, refused: bool = False, **changed: Any) -> int:
    """A batch of its own, of these parts alone."""
    out = tmp_path / f"out{len(list(tmp_path.glob('out*')))}"
    found = recordings([film.part_of(file, part) for part in parts], out)
    names = [recording.name for recording in found] if refused else []
    return run_batch(options(out, write_back=True, **changed), found, placed(tmp_path, *names), ["act"])


def verdicts(folder: Path) -> dict[tuple[int, str], str]:
    rows = pq.read_table(folder / TABLE).to_pylist()
    assert all(len(row["frame_index"]) == 2 * (row["verdict"] == "OK") for row in rows)
    return {(row["episode_index"], row["camera"]): row["verdict"] for row in rows}


def test_rows_of_other_episodes_and_cameras_stay(tmp_path, data_set):  # noqa: F811
    assert ran(tmp_path, data_set, "1/top", "0/side") == EXIT_GOOD
    assert ran(tmp_path, data_set, "0/top") == EXIT_GOOD
    assert ran(tmp_path, data_set, "1/side", "0/side", refused=True) == EXIT_GOOD
    expected = {(0, "side"): "NO_OVERLAP", (0, "top"): "OK", (1, "side"): "NO_OVERLAP", (1, "top"): "OK"}
    assert list(verdicts(data_set).items()) == list(expected.items()), "in this order"


def test_in_place_values_of_other_episodes_and_cameras_stay(tmp_path, data_set):  # noqa: F811
    file = data_set / EPISODES
    before = pq.read_table(file)

    def column(name: str) -> list[Any]:
        return pq.read_table(file).column(f"splatnode/{name}").to_pylist()

    assert ran(tmp_path, data_set, "0/top", in_place=True) == EXIT_GOOD
    assert column("top/verdict") == ["OK", None] and column("top/frame_index") == [[0, 2], None]
    assert ran(tmp_path, data_set, "1/top", in_place=True) == EXIT_GOOD
    assert column("top/verdict") == ["OK", "OK"]
    assert ran(tmp_path, data_set, "1/side", "1/top", refused=True, in_place=True) == EXIT_GOOD
    assert column("top/verdict") == ["OK", "NO_OVERLAP"] and column("side/verdict") == [None, "NO_OVERLAP"]
    assert column("top/frame_index") == [[0, 2], []] and len(column("top/T_world_camera")[0][1]) == 16
    assert pq.read_table(file).select(before.column_names) == before


def counted(file: Path) -> dict[str, int]:
    """How many messages each topic has."""
    with file.open("rb") as stream:
        told = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    return {topic: told.count(topic) for topic in sorted(set(told))}


@pytest.mark.parametrize("in_place", [False, True])
def test_topics_of_other_images_stay(tmp_path, drive, in_place):  # noqa: F811
    target = drive if in_place else tmp_path / "drive.splatnode.mcap"
    assert ran(tmp_path, drive, "/a", in_place=in_place) == EXIT_GOOD
    once = target.read_bytes()
    assert ran(tmp_path, drive, "/a", in_place=in_place) == EXIT_GOOD
    assert target.read_bytes() == once, "the second time they take the place of the first"
    target.chmod(0o640)
    assert ran(tmp_path, drive, "/b", refused=True, in_place=in_place) == EXIT_GOOD
    own = {topic: count for topic, count in counted(target).items() if "/splatnode/" in topic}
    of_a = {"/a/splatnode/calibration": 2, "/a/splatnode/pose": 2, "/a/splatnode/verdict": 1}
    assert own == {**of_a, "/b/splatnode/verdict": 1} and target.stat().st_mode & 0o777 == 0o640
    assert ran(tmp_path, drive, "/a", refused=True, in_place=in_place) == EXIT_GOOD
    assert {topic for topic in counted(target) if "/splatnode/" in topic} == {
        "/a/splatnode/verdict",
        "/b/splatnode/verdict",
    }, "the poses of /a are those of a batch before"


def parquet(**columns: list[Any]) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns), sink)
    return sink.getvalue().to_pybytes()


WHOLE = parquet(episode_index=[0], camera=["top"], verdict=["OK"])
FOOTER = len(WHOLE) - 8 - int.from_bytes(WHOLE[-8:-4], "little")  # where it begins
DAMAGED = WHOLE[:FOOTER] + bytes([255] * 50) + WHOLE[FOOTER + 50 :]
FOREIGN = {
    "is no Parquet": (b"no table", r"must be a table of cameras .* move it away, or mend it: must be a Parquet file"),
    "breaks off": (WHOLE[:-20], "must be a table of cameras .* or mend it: must be a Parquet file"),
    "is damaged": (DAMAGED, "must be a table of cameras .* or mend it: cannot be read"),
    "has other columns": (parquet(episode_index=[0], camera=["top"], mine=[1]), r"it has other columns \(mine\)"),
    "lacks a column": (parquet(episode_index=[0]), "it has no column camera"),
    "has no key": (parquet(episode_index=[None, 0], camera=["top", "top"]), "rows of no episode or no camera"),
    "has another type": (parquet(episode_index=[0], camera=["top"], width=["a"]), "or mend it: cannot be read"),
}


@pytest.mark.parametrize("which", FOREIGN)
def test_a_table_that_is_not_ours_is_left_as_it_is(tmp_path, data_set, which, capsys):  # noqa: F811
    content, expected = FOREIGN[which]
    (data_set / TABLE).write_bytes(content)
    assert ran(tmp_path, data_set, "1/top") == EXIT_SOME_FAILED
    said = capsys.readouterr().out
    assert "were not written back: " in said and "splatnode_cameras.parquet" in said
    assert re.search(expected, said), said
    assert (data_set / TABLE).read_bytes() == content and not list((data_set / "meta").rglob("*.partial"))


def test_a_table_with_fewer_columns_is_filled_up(tmp_path, data_set):  # noqa: F811
    (data_set / TABLE).write_bytes(WHOLE)
    assert ran(tmp_path, data_set, "1/top") == EXIT_GOOD
    rows = pq.read_table(data_set / TABLE).to_pylist()
    assert [(row["verdict"], row["frame_index"]) for row in rows] == [("OK", None), ("OK", [0, 2])]


def test_in_place_a_column_that_is_not_ours_or_damage_is_said(tmp_path, data_set, capsys):  # noqa: F811
    file = data_set / EPISODES
    table = pq.read_table(file)
    pq.write_table(table.append_column("splatnode/top/width", pa.array(["wide", "narrow"])), file)
    before = file.read_bytes()
    assert ran(tmp_path, data_set, "1/top", in_place=True) == EXIT_SOME_FAILED
    assert "file-000.parquet': the column splatnode/top/width: cannot be read (" in capsys.readouterr().out
    assert file.read_bytes() == before


def test_a_log_beside_that_is_damaged_or_a_full_disk_leaves_it(tmp_path, drive, monkeypatch, capsys):  # noqa: F811
    target = tmp_path / "drive.splatnode.mcap"
    assert ran(tmp_path, drive, "/a") == EXIT_GOOD
    whole = target.read_bytes()
    for damaged in (whole[: len(whole) // 4], b"no log"):
        target.write_bytes(damaged)
        assert ran(tmp_path, drive, "/b") == EXIT_SOME_FAILED
        assert "drive.splatnode.mcap' is no MCAP file that is whole" in capsys.readouterr().out
        assert target.read_bytes() == damaged
    target.write_bytes(whole)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("splatnode.extras.batch.mcap.add_messages", full)
    assert ran(tmp_path, drive, "/b") == EXIT_SOME_FAILED
    assert target.read_bytes() == whole and not list(tmp_path.glob(".*.partial"))


def test_a_log_of_somebody_beside_keeps_its_topics(tmp_path, drive):  # noqa: F811
    target = mcap_files.write(tmp_path / "drive.splatnode.mcap", [mcap_files.compressed("/mine", PICTURE)])
    assert ran(tmp_path, drive, "/a") == EXIT_GOOD
    assert counted(target)["/mine"] == 1 and counted(target)["/a/splatnode/pose"] == 2
