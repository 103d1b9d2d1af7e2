"""A camera that is lost, silent, slow or back in time, read by a process that must not wait for it."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from splatnode.capture.frame import CameraUnavailable, DroppedFrame, Frame, KeepAlive
from splatnode.capture.reader import Config, Reader, ReaderState
from tests.capture.messaging.test_sockets import wait_for

QUICK = Config(frame_timeout_s=0.2, first_pause_s=0.01, longest_pause_s=0.05, reconnect_timeout_s=1.0)


def frame(index, stamp_ns=None):
    return Frame(index, f"{index}", index if stamp_ns is None else stamp_ns, np.zeros((2, 2, 3), np.uint8), None)


def recorded(items):
    return lambda: iter(items)


def read_all(reader):
    items = []

    def finished():
        if (item := reader.next(0.05)) is not None:
            items.append(item)
        return reader.state is ReaderState.FINISHED

    wait_for(finished)
    return items


@pytest.fixture
def clock(monkeypatch):
    """What readers take for the time, which stands still until the test moves it."""
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr("splatnode.capture.reader.time", SimpleNamespace(monotonic=lambda: now.s))
    return now


def test_a_recording_is_read_whole_however_slow_the_reader():
    sent = [frame(0), DroppedFrame("x", "blurred"), *(frame(index) for index in range(1, 8))]
    with Reader(recorded(sent), live=False, config=QUICK) as reader:
        time.sleep(0.1)
        items = read_all(reader)
    assert [item.name for item in items] == [item.name for item in sent]
    assert reader.skipped == 0


def test_a_recording_is_not_finished_before_all_of_it_was_read():
    with Reader(recorded([frame(0), frame(1)]), live=False, config=QUICK) as reader:
        reader._thread.join(60)
        states = [reader.state]
        while reader.next(0.05) is not None:
            states.append(reader.state)
    assert states == [ReaderState.STREAMING, ReaderState.STREAMING, ReaderState.FINISHED]


def test_of_a_live_camera_the_newest_are_read():
    seen = threading.Event()

    def camera():
        for index in range(100):
            yield frame(index)
        seen.set()
        time.sleep(0.3)

    with Reader(camera, live=True, config=QUICK) as reader:
        assert seen.wait(60)
        wait_for(lambda: reader.skipped == 98)
        assert [reader.next(0.1).name, reader.next(0.1).name] == ["98", "99"]


def test_a_lost_camera_comes_back_under_new_numbers():
    openings = []

    def camera():
        openings.append(time.monotonic())
        if len(openings) in (2, 3):
            raise CameraUnavailable("no camera at /dev/video0")
        yield frame(0, stamp_ns=len(openings) * 10)
        yield frame(1, stamp_ns=len(openings) * 10 + 1)
        if len(openings) < 5:
            raise CameraUnavailable("unplugged")

    with Reader(camera, live=False, config=msgspec.structs.replace(QUICK, reconnect_timeout_s=60.0)) as reader:
        items = read_all(reader)
    assert [item.frame_id for item in items] == [0, 1, 2, 3, 4, 5]
    assert len(openings) == 5 and reader.why == ""
    pauses = np.diff(openings)
    assert pauses[1] > 0.015 and pauses[2] > 0.035  # 0.01, 0.02, 0.04


def test_a_loss_is_over_once_the_camera_is_there_though_it_has_no_frame(clock):
    """A watched folder that is back may get no photograph for days."""
    lost, back = threading.Event(), threading.Event()

    def camera():
        if lost.is_set():
            raise CameraUnavailable("cannot watch the folder")
        while not lost.is_set():
            back.set()
            yield KeepAlive()
            time.sleep(0.001)
        raise CameraUnavailable("cannot watch the folder")

    def is_lost_and_back():
        lost.set()
        wait_for(lambda: reader.state is ReaderState.DEGRADED and "cannot watch" in reader.why)
        back.clear()
        lost.clear()
        wait_for(lambda: back.is_set() and reader.state is ReaderState.STARTING and not reader.why)
        assert reader.next(0) is None

    with Reader(camera, live=False, config=QUICK) as reader:
        for _ in range(3):  # longer altogether than it may be lost at once
            is_lost_and_back()
            clock.s += 0.8


def test_while_it_is_lost_it_says_so(clock):
    lost = threading.Event()

    def camera():
        if lost.is_set():
            raise CameraUnavailable("no camera at /dev/video0")
        yield frame(0)
        lost.set()
        raise CameraUnavailable("unplugged")

    with Reader(camera, live=True, config=QUICK) as reader:
        assert reader.next(60).name == "0"
        wait_for(lambda: reader.state is ReaderState.DEGRADED and "no camera" in reader.why)
        clock.s += 1.1
        with pytest.raises(CameraUnavailable, match="no frame|no camera"):
            while True:
                reader.next(0.05)


def test_a_camera_that_is_not_there_at_first_is_not_waited_for():
    def camera():
        raise CameraUnavailable("no camera at /dev/video0")
        yield

    with Reader(camera, live=True, config=QUICK) as reader, pytest.raises(CameraUnavailable) as caught:
        reader.next(60)
    assert caught.value.exit_code == 69


def test_a_silent_camera_is_degraded_and_then_given_up(clock):
    closing = threading.Event()

    def camera():
        yield frame(0)
        closing.wait(60)

    with Reader(camera, live=True, config=QUICK) as reader, contextlib.ExitStack() as end:
        end.callback(closing.set)
        assert reader.next(60) is not None and reader.state is ReaderState.STREAMING
        clock.s += 0.3
        assert reader.state is ReaderState.DEGRADED
        clock.s += 1.1
        with pytest.raises(CameraUnavailable, match="no frame for 1 s"):
            while True:
                reader.next(0.05)


def test_a_camera_of_damaged_frames_alone_is_degraded_and_then_given_up(clock):
    def camera():
        yield frame(0)
        for index in itertools.count():
            time.sleep(0.001)
            yield DroppedFrame(str(index), "the driver says that it is damaged")

    with Reader(camera, live=True, config=QUICK) as reader:
        assert reader.next(60) is not None
        wait_for(lambda: isinstance(reader.next(60), DroppedFrame))
        clock.s += 0.3
        wait_for(lambda: isinstance(reader.next(60), DroppedFrame) and reader.state is ReaderState.DEGRADED)
        clock.s += 1.1
        with pytest.raises(CameraUnavailable, match="no frame for 1 s that can be used; the last: the driver says"):
            while True:
                reader.next(60)


def test_a_frame_from_before_the_last_one_is_dropped():
    with Reader(recorded([frame(0, 50), frame(1, 40), frame(2, 60)]), False, QUICK) as reader:
        first, second, third = read_all(reader)
    assert [first.frame_id, third.frame_id] == [0, 1]
    assert second == DroppedFrame("1", "its time stamp is 10 ns before the last")


def test_frames_of_one_time_are_kept_of_a_recording_and_given_twice_by_a_live_camera():
    sent = [frame(0, 50), frame(1, 50)]
    with Reader(recorded(sent), live=False, config=QUICK) as reader:
        assert [(item.name, item.frame_id) for item in read_all(reader)] == [("0", 0), ("1", 1)]
    with Reader(recorded(sent), live=True, config=QUICK) as reader:
        _, second = read_all(reader)
        assert second == DroppedFrame("1", "its time stamp is that of the last frame: the camera gave one twice")


def test_other_errors_are_not_hidden():
    def camera():
        yield frame(0)
        raise ZeroDivisionError("a bug")

    with Reader(camera, live=False, config=QUICK) as reader, pytest.raises(ZeroDivisionError):
        while True:
            reader.next(0.05)


def test_closing_closes_the_camera():
    closed = threading.Event()

    def camera():
        try:
            index = 0
            while True:
                yield frame(index)
                index += 1
        finally:
            closed.set()

    with Reader(camera, live=False, config=QUICK) as reader:
        reader.next(60)
    assert closed.is_set()
