"""Folders that are made and claimed: none stays empty, one process at a time, a killed one's claim ends with it."""

from __future__ import annotations

import multiprocessing
import os
import signal

import pytest

from splatnode.capture.process.files import LOCK, LockHeld, claim_folder, exclusive, make_folder


def test_a_folder_that_stays_empty_is_removed_with_those_above_it(tmp_path):
    with make_folder(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b").is_dir()
    assert not any(tmp_path.iterdir())


def test_what_is_used_or_was_there_before_stays(tmp_path):
    (tmp_path / "before").mkdir()
    with make_folder(tmp_path / "before" / "a" / "b"), make_folder(tmp_path / "before"):
        (tmp_path / "before" / "a" / "file").touch()
    assert {path.name for path in (tmp_path / "before").rglob("*")} == {"a", "file"}


def test_where_one_cannot_be_made_those_above_it_are_removed(tmp_path):
    long = "x" * 300
    with pytest.raises(OSError, match="too long"), make_folder(tmp_path / "a" / long):
        pytest.fail("cannot be made")
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(NotADirectoryError), make_folder(path):
            pytest.fail("cannot be made")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_second_claim_is_refused_with_the_holder_and_nothing_stays(tmp_path):
    with claim_folder(tmp_path / "a"), pytest.raises(LockHeld) as refused, claim_folder(tmp_path / "a"):
        pytest.fail("was claimed twice")
    assert refused.value.pid == os.getpid()
    assert not any(tmp_path.iterdir())


def _claim(folder, started):
    with claim_folder(folder):
        started.set()
        signal.pause()


def test_a_killed_process_no_longer_holds_its_folder(tmp_path):
    spawned = multiprocessing.get_context("spawn")
    started = spawned.Event()
    process = spawned.Process(target=_claim, args=(tmp_path / "a", started))
    process.start()
    assert started.wait(60)
    with pytest.raises(LockHeld) as refused, claim_folder(tmp_path / "a"):
        pytest.fail("was claimed twice")
    assert refused.value.pid == process.pid
    process.kill()
    process.join()
    assert (tmp_path / "a" / LOCK).exists()
    with claim_folder(tmp_path / "a"):
        pass


def test_a_lock_file_that_its_holder_removes_does_not_lock_for_two(tmp_path):
    """Its inode may have been opened by another process just before."""
    path = tmp_path / "lock"
    with open(path, "a+"), exclusive(path):
        path.unlink()
        with exclusive(path), pytest.raises(LockHeld), exclusive(path):
            pytest.fail("was locked twice")
