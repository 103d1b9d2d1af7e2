"""A journal keeps what the whole does not hold yet."""

from __future__ import annotations

import math

import pytest

from splatnode.extras.evaluate import runner
from splatnode.extras.evaluate.runner import Journal


def test_what_a_killed_process_left_is_found(tmp_path):
    journal = tmp_path / "journal"
    killed = Journal(journal, lambda: None)
    killed.add({"run": 1})
    killed.add({"run": 2})
    with journal.open("ab") as file:
        file.write(b'{"run": 3')  # it was killed in the middle of a line
    written = []
    with Journal(journal, lambda: written.append(list(known))) as goes_on:
        known = goes_on.recover_records()
        assert known == [{"run": 1}, {"run": 2}]
        known.append({"run": 3})
        goes_on.add(known[-1])
        assert [*map(len, journal.read_bytes().splitlines())] == [10, 10, 10] and not written
    assert written == [known] and not journal.exists()


def test_a_number_that_the_whole_cannot_hold_is_not_kept(tmp_path):
    journal = tmp_path / "journal"
    with pytest.raises(ValueError, match="JSON"):
        Journal(journal, lambda: None).add({"run": math.nan})
    assert journal.read_bytes() == b""
    journal.write_bytes(b'{"run": 1}\n{"run": NaN}\n{"run": [-Infinity]}\n')  # of an older version
    assert Journal(journal, lambda: None).recover_records() == [{"run": 1}]


def test_the_whole_is_written_now_and_then(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "WRITE_EVERY_S", 0.0)
    journal, written = tmp_path / "journal", []
    with Journal(journal, lambda: written.append(True)) as goes_on:
        goes_on.add(1)
        assert written == [True] and journal.read_bytes() == b""
    assert written == [True]  # there was nothing left to write


def test_an_interruption_loses_nothing_and_a_full_disk_leaves_the_journal(tmp_path):
    journal, written = tmp_path / "journal", []
    with pytest.raises(KeyboardInterrupt), Journal(journal, lambda: written.append(True)) as goes_on:
        goes_on.add(1)
        raise KeyboardInterrupt
    assert written == [True] and not journal.exists()

    def full() -> None:
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space"), Journal(journal, full) as goes_on:
        goes_on.add(2)
    assert Journal(journal, full).recover_records() == [2]
