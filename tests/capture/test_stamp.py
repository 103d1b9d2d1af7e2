"""Time stamps keep every digit, and a live camera's are what the wall clock showed."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from splatnode.capture.frame import LARGEST_NS, Clock, Stamp, nearest_stamp, wall_clock


@pytest.mark.parametrize(
    ("ns", "text"),
    [(0, "0.000000000"), (7, "0.000000007"), (1_714_982_400_250_000_001, "1714982400.250000001")],
)
def test_seconds_have_all_nanoseconds(ns, text):
    assert Stamp(ns, Clock.UTC).seconds == text


@pytest.mark.parametrize("ns", [-1, LARGEST_NS + 1])
def test_what_no_clock_shows_is_refused(ns):
    with pytest.raises(ValueError, match="0 to 2\\*\\*62"):
        Stamp(ns, Clock.FILE)


def test_a_moment_of_the_monotonic_clock_is_told_by_the_wall_clock():
    mono_ns, before = time.monotonic_ns(), time.time_ns()
    now, earlier = wall_clock(mono_ns), wall_clock(mono_ns - 3_000_000_000)
    assert now.clock is earlier.clock is Clock.UTC
    assert abs(now.ns - before) < 100_000_000 and abs(now.ns - earlier.ns - 3_000_000_000) < 100_000_000


def test_a_reading_of_the_clocks_that_was_disturbed_does_not_count(monkeypatch):
    """The process may lose the processor between two readings: here for 50 ms in all but one of five."""
    monotonic = iter([0, 50_000_000] * 2 + [100, 300] + [0, 50_000_000] * 2)
    wall = iter([10**18 + 50_000_000] * 2 + [10**18 + 200] + [10**18 + 50_000_000] * 2)
    monkeypatch.setattr(time, "monotonic_ns", lambda: next(monotonic))
    monkeypatch.setattr(time, "time_ns", lambda: next(wall))
    assert wall_clock(1000).ns == 10**18 + 1000


@pytest.mark.parametrize(("shown", "told"), [(-(10**20), 0), (LARGEST_NS + 10**18, LARGEST_NS)])
def test_a_clock_that_is_set_to_any_year_ends_no_camera(monkeypatch, shown, told):
    monkeypatch.setattr("splatnode.capture.frame.time", SimpleNamespace(monotonic_ns=lambda: 0, time_ns=lambda: shown))
    assert wall_clock(1000) == nearest_stamp(shown, Clock.UTC) == Stamp(told, Clock.UTC)
