"""What nobody takes is kept with its reason, within its bound, and told until seen; no file stands in the way."""

from __future__ import annotations

import os

import pytest

from splatnode.capture.messaging.keyframe_queue import Quarantine, QuarantineConfig, QuarantinedKeyframe


@pytest.fixture
def waiting(tmp_path):
    """Makes a file as it waits in the spool."""
    (tmp_path / "spool").mkdir()

    def make(index, size=10):
        path = tmp_path / "spool" / f"{index:012d}-{'0' * 32}-{index}.frame"
        path.write_bytes(bytes(size))
        return path

    return make


def open_quarantine(tmp_path, **limits):
    return Quarantine(tmp_path / "quarantine", QuarantineConfig(**limits))


def test_what_is_set_aside_is_there_after_a_restart_with_its_reason(tmp_path, waiting):
    quarantine = open_quarantine(tmp_path)
    for index in range(3):
        path = waiting(index)
        quarantine.take(path, f"{index}.png", f"too\nlarge: {index}")
        assert not path.exists()
    for each in (quarantine, open_quarantine(tmp_path)):
        assert len(each) == each.unseen == 3
        newest, _ = each.newest(2)
        assert newest == QuarantinedKeyframe("2.png", "too\\nlarge: 2", f"{2:012d}-{'0' * 32}-2.frame")
        assert each.newest(0) == ()
    assert all(path.stat().st_mode & 0o077 == 0 for path in quarantine.directory.iterdir() if path.suffix == ".json")


def test_what_was_seen_is_not_told_again_also_after_a_restart(tmp_path, waiting):
    quarantine = open_quarantine(tmp_path)
    quarantine.take(waiting(0), "a", "b")
    quarantine.mark_seen()
    for each in (quarantine, open_quarantine(tmp_path)):
        assert (len(each), each.unseen) == (1, 0)
    quarantine.take(waiting(1), "c", "d")
    assert open_quarantine(tmp_path).unseen == 1


@pytest.mark.parametrize("limits, kept", [({"max_frames": 2}, 2), ({"max_mb": 1}, 1)])
def test_the_oldest_go_where_there_are_too_many(tmp_path, waiting, limits, kept):
    quarantine = open_quarantine(tmp_path, **limits)
    for index in range(5):
        quarantine.take(waiting(index, size=600_000), f"{index}.png", "refused")
    again = open_quarantine(tmp_path, **limits)
    assert [each.name for each in again.newest(9)] == [f"{index}.png" for index in range(4, 4 - kept, -1)]
    assert len(list(quarantine.directory.glob("*.frame"))) == len(list(quarantine.directory.glob("*.json"))) == kept
    assert len(open_quarantine(tmp_path, max_frames=1)) == 1  # a bound that was lowered holds, too


RECORDS = [b"", b"{", b"[]", b'{"name": 1}', b"[" * 100_000, b"x" * 100_000, b"\xff" * 50,
           b'{"name": "\\u001b", "reason": "", "file": "x"}', b'{"name": "", "reason": "", "file": "x"}']  # fmt: skip


@pytest.mark.parametrize("content", RECORDS, ids=lambda content: repr(content[:20]))
@pytest.mark.parametrize("which", ["000000000000.json", "seen"])
def test_files_that_say_nothing_stand_in_nobodys_way(tmp_path, waiting, content, which):
    quarantine = open_quarantine(tmp_path)
    quarantine.take(waiting(0), "a", "b")
    (quarantine.directory / which).write_bytes(content)
    again = open_quarantine(tmp_path)
    assert len(again) == again.unseen == 1
    if which != "seen":
        assert again.newest(1)[0].reason == "its reason was lost"


def test_strangers_are_left_alone(tmp_path, waiting):
    quarantine = open_quarantine(tmp_path)
    quarantine.take(waiting(0), "a", "b")
    (quarantine.directory / "000000000007.frame").mkdir()
    (quarantine.directory / "copy of 1.frame").write_bytes(b"")
    os.symlink("/etc/hostname", quarantine.directory / "000000000009.frame")
    assert len(open_quarantine(tmp_path)) == 1


def test_a_disk_that_takes_nothing_costs_no_more_than_the_reason(tmp_path, waiting, monkeypatch):
    quarantine = open_quarantine(tmp_path)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("splatnode.capture.messaging.keyframe_queue.write_atomically", full)
    quarantine.take(waiting(0), "a", "b")
    assert quarantine.newest(1)[0].reason == "b"
    quarantine.mark_seen()
    assert quarantine.unseen == 0
    path = waiting(1)
    path.unlink()
    quarantine.take(path, "gone", "it is not there")
    assert len(quarantine) == 1
