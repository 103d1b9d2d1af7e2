"""Pauses of work with a deadline."""

from __future__ import annotations

import math
import time

import pytest

from splatnode.recon.threads import OutOfTime, RunContext


def test_a_pause_is_asked_first_and_then_the_time():
    asked = []
    for deadline in (math.inf, time.monotonic() + 1e6):
        RunContext(lambda: asked.append(1), deadline).end_at_deadline().pause()
    with pytest.raises(OutOfTime):
        RunContext(lambda: asked.append(3), time.monotonic() - 1).end_at_deadline().pause()
    assert asked == [1, 1, 3]


def test_the_earlier_of_two_deadlines_counts():
    assert RunContext(deadline=5.0).advance_deadline(3.0).deadline == 3.0
    assert RunContext(deadline=5.0).advance_deadline(8.0).deadline == 5.0


def test_pauses_report_what_is_being_done():
    told = []
    RunContext(lambda: told.append("paused"), tell=lambda step: told.append(str(step))).report("matching").pause()
    assert told == ["matching", "paused"]
