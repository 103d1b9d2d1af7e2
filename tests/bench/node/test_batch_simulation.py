"""The benchmark of many recordings, small: a killed driver repeats what was running, and nothing is lost."""

from __future__ import annotations

from tests.bench.node.batch_simulation import simulate
from tests.bench.node.simulated_batch import MOST_CORES

COUNT, KILLS = 80, 2


def test_each_recording_has_one_end_though_the_driver_is_killed(tmp_path):
    row = simulate(tmp_path, COUNT, KILLS)
    assert row["rows"] == row["as_expected"] == COUNT
    assert row["results_whole"] == COUNT - row["verdicts"].get("FAILED", 0) and row["hidden_files_left"] == 0
    assert row["began"] == COUNT + row["repeated"]
    assert row["repeated"] <= KILLS * MOST_CORES, "at most what was running"
    assert row["last_life"]["recordings"] >= COUNT - COUNT // 20 * KILLS - KILLS
