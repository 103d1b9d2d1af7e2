"""Tables that take far more memory than their bytes, or that are none."""

from __future__ import annotations

import os
import resource
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatnode.extras import lerobot
from splatnode.extras.lerobot import UnusableDataSet, film, list_parts
from tests.support.lerobot_sets import read_tables_here, write

pa = pytest.importorskip("pyarrow", reason="needs pyarrow")
pq = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")

TOP = "observation.images.top"
MOST_OWN = 300_000_000  # bytes that our own process may take for a data set's tables


@pytest.fixture
def folder(tmp_path) -> Path:
    return write(tmp_path / "set", [{TOP: [np.zeros((48, 64, 3), np.uint8)]}])


@pytest.fixture
def unguarded(monkeypatch):
    """Tables are read by this process, which the other tests show to be guarded."""
    read_tables_here(monkeypatch)


def put(folder: Path, table: Any, **how: Any) -> Path:
    file = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    pq.write_table(table, file, **how)
    return file


def columns(episodes: Any, **further: Any) -> Any:
    """A table of episodes, whose columns about the camera are nulls unless they are given."""
    names = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    nothing = pa.nulls(len(episodes))
    given = {f"videos/{TOP}/{name}": further.get(name, nothing) for name in names}
    return pa.table({"episode_index": episodes, **given})


def test_rows_are_counted_before_they_are_read(folder):
    """Three million rows of one value are some kilobytes."""
    file = put(folder, columns(pa.array(np.zeros(3_000_000, np.int64))))
    assert file.stat().st_size < 100_000
    with pytest.raises(UnusableDataSet, match="at most 1000000 rows, it has 3000000; split it"):
        list_parts(folder)


def test_rows_of_all_files_together_are_bounded(folder, unguarded):
    file = put(folder, columns(pa.array(np.zeros(400_000, np.int64))))
    for index in range(1, 3):
        (file.parent / f"file-00{index}.parquet").write_bytes(file.read_bytes())
    with pytest.raises(UnusableDataSet, match="at most 1000000 rows, it has more"):
        list_parts(folder)


@pytest.mark.parametrize(
    ("episodes", "told"),
    [
        (pa.array(["0"]), "must be of numbers, it is of string"),
        (pa.array([[0] * 3]), "must be of numbers, it is of list"),
        (pa.array([{"a": 0}]), "must be of numbers, it is of struct"),
        (pa.array([None], pa.int64()), "a number in each row"),
        (pa.array([np.nan]), "a number in each row"),
        (pa.array([-1]), "a whole number of 0 to 1000000000, it is -1"),
        (pa.array([1e300]), "a whole number of 0 to 1000000000, it is 1e"),
        (pa.array([0.5]), "a whole number of 0 to"),
        (pa.array([2**62 + 1]), "cannot be read|whole number"),
    ],
)
def test_numbers_of_episodes_are_whole_and_within_bounds(folder, unguarded, episodes, told):
    put(folder, columns(episodes))
    with pytest.raises(UnusableDataSet, match=told):
        list_parts(folder)


@pytest.mark.parametrize("value", [1e300, -1.0, 0.5, float("inf"), float("nan")])
def test_numbers_of_files_are_whole_and_within_bounds(folder, unguarded, value):
    given = {"chunk_index": pa.array([value]), "file_index": pa.array([0])}
    put(folder, columns(pa.array([0]), **given, from_timestamp=pa.array([0.0]), to_timestamp=pa.array([1.0])))
    with pytest.raises(UnusableDataSet, match="whole number|has no images"):
        film(folder, f"0/{TOP}")


def test_texts_that_unfold_to_gigabytes_end_the_process_that_reads_them_and_no_other(folder):
    """One text of 10 MB, which a dictionary names a thousand times."""
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(1000, np.int32)), pa.array(["x" * 10_000_000]))
    file = put(
        folder, columns(pa.array(range(1000))).append_column("task", text), compression="zstd", store_schema=False
    )
    assert file.stat().st_size < 100_000
    assert len(list_parts(folder)) == 1000, "what is not needed is not read"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(UnusableDataSet, match="the table: .*(memory|cannot be read|ended)"):
        lerobot.check_whole(file, UnusableDataSet, "the table")
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < MOST_OWN


@pytest.mark.parametrize("length", [2**32 - 1, 10**8, 0])
def test_a_directory_longer_than_its_file_is_refused(folder, length):
    file = put(folder, columns(pa.array([0])))
    file.write_bytes(file.read_bytes()[:-8] + struct.pack("<I", length) + b"PAR1")
    with pytest.raises(UnusableDataSet, match="its directory must have at most|cannot be read"):
        list_parts(folder)


def test_damaged_bytes_are_refused_by_a_sentence(folder):
    file = put(folder, columns(pa.array(range(2000))))
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    for _ in range(4):
        damaged = bytearray(whole)
        for place in rng.integers(4, len(whole), 30):
            damaged[place] = rng.integers(256)
        file.write_bytes(damaged)
        try:
            assert len(list_parts(folder)) <= 2000
        except UnusableDataSet as error:
            assert str(error).isprintable()


def test_a_pipe_is_no_table(folder, unguarded, tmp_path):
    os.mkfifo(folder / "meta" / "episodes" / "chunk-000" / "file-001.parquet")
    with pytest.raises(UnusableDataSet, match="must be a file, is a pipe or a device"):
        list_parts(folder)
