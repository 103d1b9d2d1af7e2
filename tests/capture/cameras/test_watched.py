"""A folder that is written to while it is watched: each photograph once, and only when it is whole."""

from __future__ import annotations

import errno
import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import watched
from splatnode.capture.cameras.watched import Config, stream
from splatnode.capture.config import Camera, camera_opener
from splatnode.capture.frame import (
    CameraUnavailable,
    Clock,
    DroppedFrame,
    ExposureSettings,
    Frame,
    Intrinsics,
    KeepAlive,
    Stamp,
)
from splatnode.capture.reader import Config as ReaderConfig
from splatnode.capture.reader import Reader, ReaderState
from tests.capture.cameras.test_folder import with_exif
from tests.capture.messaging.test_sockets import wait_for

QUICK = {"poll_s": 0.01, "stable_s": 0.05, "file_timeout_s": 0.4}


def photograph(index=0, suffix=".jpg"):
    image = np.random.default_rng(index).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    return cv2.imencode(suffix, image)[1].tobytes()


def watch(folder, **config) -> Any:
    return stream(Config(folder, **{**QUICK, **config}))


def opened(opener) -> Any:
    """The photographs of one opening."""
    return (item for item in opener() if not isinstance(item, KeepAlive))


def slowly(path, data, pieces=6, pause_s=0.03):
    def write():
        with path.open("wb") as file:
            for start in range(0, len(data), len(data) // pieces + 1):
                file.write(data[start : start + len(data) // pieces + 1])
                file.flush()
                time.sleep(pause_s)

    thread = threading.Thread(target=write)
    thread.start()
    return thread


def test_photographs_come_once_in_their_order(tmp_path):
    for index, name in enumerate(["img10.jpg", "img2.png"]):
        (tmp_path / name).write_bytes(photograph(index, name[-4:]))
    frames = watch(tmp_path)
    assert [next(frames).name, next(frames).name] == ["img2.png", "img10.jpg"]
    (tmp_path / "a.jpg").write_bytes(photograph(2))
    before = time.monotonic_ns()
    third = next(frames)
    assert (third.name, third.frame_id) == ("a.jpg", 2) and before < third.stamp_ns <= time.monotonic_ns()


def test_a_photograph_has_its_own_time_and_else_that_of_its_file(tmp_path):
    told = {0x9003: "2024:05:06 10:00:07", 0x829A: (1, 125), 0x8827: 400}
    (tmp_path / "a.jpg").write_bytes(with_exif(photograph(0), {}, told))
    (tmp_path / "b.jpg").write_bytes(photograph(1))
    os.utime(tmp_path / "b.jpg", ns=(0, 1_714_989_607_123_456_000))
    (tmp_path / "c_20240506_100009.jpg").write_bytes(photograph(2))
    frames = watch(tmp_path)
    first = next(frames)
    assert first.captured_at == Stamp(1_714_989_607_000_000_000, Clock.LOCAL)
    assert first.exposure == ExposureSettings(0.008, 400.0)
    assert next(frames).captured_at == Stamp(1_714_989_607_123_456_000, Clock.FILE)
    assert next(frames).captured_at == Stamp(1_714_989_609_000_000_000, Clock.LOCAL)


@pytest.mark.parametrize("pause_s", [0.02, 0.1])  # 0.1: it pauses for longer than it takes to settle
def test_a_file_that_is_being_written_is_waited_for(tmp_path, pause_s):
    data = photograph()
    writer = slowly(tmp_path / "slow.jpg", data, pause_s=pause_s)
    frame = next(watch(tmp_path, file_timeout_s=10))
    writer.join()
    assert isinstance(frame, Frame) and frame.encoded == data


def test_a_file_that_never_becomes_whole_is_named(tmp_path, monkeypatch):
    now = [0.0]

    def sleep(seconds):
        now[0] += seconds

    clock = SimpleNamespace(monotonic=lambda: now[0], monotonic_ns=lambda: round(now[0] * 1e9), sleep=sleep)
    monkeypatch.setattr("splatnode.capture.cameras.watched.time", clock)
    (tmp_path / "half.jpg").write_bytes(photograph()[:-500])
    (tmp_path / "whole.jpg").write_bytes(photograph(1))
    frames = watch(tmp_path)
    assert next(frames).name == "whole.jpg"  # one file does not hold up the others
    dropped = next(frames)
    assert isinstance(dropped, DroppedFrame) and dropped.name == "half.jpg"
    assert "truncated" in dropped.reason and "after 0 s" in dropped.reason and 0.4 <= now[0] < 0.5


@pytest.mark.parametrize(
    ("fails", "error"),
    [("read", errno.EACCES), ("read", errno.EBUSY), ("read", errno.EIO), ("stat", errno.EIO), ("stat", errno.ESTALE)],
)
def test_a_file_that_cannot_be_read_for_a_moment_is_waited_for(tmp_path, monkeypatch, error, fails):
    """As until the one who put it there changes its mode, or a network share answers again."""
    failing(monkeypatch, error, fails, times={"a.jpg": 5, "never.jpg": 10**9})
    for name in ("a.jpg", "never.jpg"):
        (tmp_path / name).write_bytes(photograph())
    frames = watch(tmp_path)
    assert next(frames).name == "a.jpg"
    dropped = next(frames)
    assert isinstance(dropped, DroppedFrame) and dropped.name == "never.jpg"
    assert dropped.reason == f"cannot be read: {os.strerror(error)}, after 0 s"


def failing(monkeypatch, error, fails, times):
    """Looks at the files of these names (`fails`: stat or read) fail so often."""

    def flaky(look):
        def looked(path, *args, **kwargs):
            if times.get(path.name, 0) > 0:
                times[path.name] -= 1
                raise OSError(error, os.strerror(error), str(path))
            return look(path, *args, **kwargs)

        return looked

    if fails == "stat":
        monkeypatch.setattr(Path, "stat", flaky(Path.stat))
    else:
        monkeypatch.setattr(watched, "read_image_file", flaky(watched.read_image_file))


def test_temporary_and_hidden_files_are_not_looked_at(tmp_path):
    for name in (".hidden.jpg", "a.jpg.tmp", "b.part.jpg", "c.tmp.png", "notes.txt"):
        (tmp_path / name).write_bytes(photograph())
    frames = watch(tmp_path)
    (tmp_path / "c.tmp.png").rename(tmp_path / "c.png")
    assert next(frames).name == "c.png"


def test_what_lies_there_can_be_left_out(tmp_path):
    (tmp_path / "old.jpg").write_bytes(photograph())
    frames = watch(tmp_path, include_existing=False)
    (tmp_path / "new.jpg").write_bytes(photograph(1))
    assert next(frames).name == "new.jpg"


def test_what_cannot_be_read_is_named(tmp_path):
    (tmp_path / "phone.dng").write_bytes(b"II*\0")
    assert "Convert it to JPEG" in next(watch(tmp_path)).reason


def test_a_folder_that_is_not_there_or_goes_is_a_lost_camera(tmp_path):
    with pytest.raises(CameraUnavailable, match="cannot watch"):
        next(watch(tmp_path / "nowhere"))
    folder = tmp_path / "stick"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(photograph())
    frames = watch(folder)
    next(frames)
    (folder / "a.jpg").unlink()
    folder.rmdir()
    with pytest.raises(CameraUnavailable, match="cannot watch"):
        next(frames)


@pytest.mark.parametrize("existing", [True, False])
def test_what_came_while_the_folder_was_away_is_taken_and_nothing_twice(tmp_path, existing):
    folder, away = tmp_path / "stick", tmp_path / "away"
    folder.mkdir()
    (folder / "old.jpg").write_bytes(photograph())
    opener = camera_opener(Camera("watched", Config(folder, existing, **QUICK)))
    frames = opened(opener)
    if existing:
        assert next(frames).name == "old.jpg"
    (folder / "new.jpg").write_bytes(photograph(1))
    assert next(frames).name == "new.jpg"
    folder.rename(away)
    with pytest.raises(CameraUnavailable, match="cannot watch"):
        next(frames)
    with pytest.raises(CameraUnavailable, match="cannot watch"):
        next(opened(opener))
    (away / "came.jpg").write_bytes(photograph(2))
    (away / "new.jpg").write_bytes(photograph(3, ".png"))  # another of the same name
    away.rename(folder)
    again = opened(opener)
    (folder / "z.jpg").write_bytes(photograph(4))
    for name in ("came.jpg", "new.jpg", "z.jpg"):
        assert next(again).name == name


def test_a_folder_that_is_back_is_no_longer_lost_though_nothing_new_is_in_it(tmp_path):
    folder, away = tmp_path / "stick", tmp_path / "away"
    folder.mkdir()
    (folder / "old.jpg").write_bytes(photograph())
    config = ReaderConfig(first_pause_s=0.01)
    white = tmp_path / "white.png"
    white.write_bytes(cv2.imencode(".png", np.full((48, 64), 255, np.uint8))[1].tobytes())
    for mask in (None, white):
        with Reader(camera_opener(Camera("watched", Config(folder, **QUICK)), mask), False, config) as reader:
            assert reader.next(60) is not None
            folder.rename(away)
            wait_for(lambda: reader.state is ReaderState.DEGRADED)
            away.rename(folder)
            wait_for(lambda: reader.state is ReaderState.STREAMING and not reader.why)


def test_photographs_that_are_gone_and_come_back_are_not_taken_again(tmp_path, monkeypatch):
    """Where nothing is mounted there is a folder, too: an empty one."""
    names = ["a.jpg", "b.jpg", "c.jpg"]
    for index, name in enumerate(names):
        (tmp_path / name).write_bytes(photograph(index))
    monkeypatch.setattr(watched, "REMEMBERED", 1)
    frames = watch(tmp_path)
    assert [next(frames).name for _ in names] == names
    kept = [((tmp_path / name).read_bytes(), (tmp_path / name).stat().st_mtime_ns) for name in names]
    for name in names:
        (tmp_path / name).unlink()
    (tmp_path / "d.jpg").write_bytes(photograph(3))
    assert next(frames).name == "d.jpg"
    for name, (data, changed_ns) in zip(names, kept, strict=True):
        (tmp_path / name).write_bytes(data)
        os.utime(tmp_path / name, ns=(0, changed_ns))
    (tmp_path / "e.jpg").write_bytes(photograph(4))
    assert [next(frames).name for _ in range(3)] == ["a.jpg", "b.jpg", "e.jpg"]  # one is remembered: the last


def test_the_lens_is_of_the_photographs_of_its_aspect_ratio(tmp_path):
    """A photograph in portrait format was not taken through a lens that is given in landscape format."""
    lens = Intrinsics(128, 96, 100.0, 100.0, 64.0, 48.0, "calibration")
    (tmp_path / "a.jpg").write_bytes(photograph())
    (tmp_path / "b.png").write_bytes(cv2.imencode(".png", np.zeros((64, 48, 3), np.uint8))[1].tobytes())
    frames = watch(tmp_path, intrinsics=lens)
    assert next(frames).intrinsics == lens.resized(64, 48) and next(frames).intrinsics is None


def test_a_photograph_of_any_year_is_one(tmp_path):
    for index, year in enumerate((1950, 2024, 2200)):
        path = tmp_path / f"{index}.jpg"
        path.write_bytes(photograph(index))
        try:
            os.utime(path, ns=2 * ((year - 1970) * 365 * 86400 * 10**9,))
        except OSError:
            pytest.skip("this file system has no such years")
    stream = watch(tmp_path)
    assert [next(stream).captured_at.clock for _ in range(3)] == [Clock.FILE] * 3
