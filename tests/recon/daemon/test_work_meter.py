"""What the node says of its work: what, how far, and how long the rest takes by what was measured here."""

from __future__ import annotations

import contextlib
import json
import time

import numpy as np
import pytest
from msgspec.structs import replace

from splatnode.capture.process.terminal import ProgressStep
from splatnode.capture.status import describe_heartbeat, read_heartbeats
from splatnode.recon.daemon import FINAL_BASE_S, FINAL_S_A_VIEW, Backlog, Work, WorkMeter, WorkProgress, weigh_final
from splatnode.recon.optimize import training
from tests.conftest import ROOT
from tests.recon.daemon.test_daemon import PATIENCE_S, config, finished, peer, running  # noqa: F401
from tests.support.synthetic import photographs


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def meter(clock) -> WorkMeter:
    return WorkMeter(clock)


def work(meter: WorkMeter, clock: Clock, kind: Work, seconds: float, size: float = 1.0) -> None:
    with meter.measure(kind, size):
        clock.now_s += seconds


def test_nothing_is_told_while_nothing_is_done(meter):
    assert meter.describe(Backlog(keyframes=3)) is None


def test_keyframes_that_wait_take_as_long_as_others_took_once_some_were_measured(meter, clock):
    with meter.measure(Work.KEYFRAMES):
        assert meter.describe(Backlog(3)) == WorkProgress("working in keyframes", 0, 3, "keyframe", None)
        clock.now_s += 2.0
    with meter.measure(Work.KEYFRAMES, 2, 2):
        clock.now_s += 1.0
        assert meter.describe(Backlog(2)) == WorkProgress("working in keyframes", 1, 3, "keyframe", 3.0)
        clock.now_s += 4.0  # longer than thought: nothing is told, rather than something wrong
        told = meter.describe(Backlog(2))
        assert told is not None and told.left_s is None
    meter.restart_count(Work.KEYFRAMES)
    with meter.measure(Work.KEYFRAMES):
        told = meter.describe(Backlog(1))
        assert told is not None and told.done == 0


def test_a_refinement_tells_its_rest_by_its_steps_and_before_them_by_the_last_one(meter, clock):
    steps = [ProgressStep("refining the scene", done, 100, "step") for done in (0, 20, 40)]
    for tried in range(2):
        with meter.measure(Work.FINAL, weigh_final(4)):
            meter.tell(ProgressStep("estimating depth"))
            meter.tell("a line that nobody waits for")
            told = meter.describe(Backlog())
            assert told == WorkProgress("estimating depth", 0, 0, "", pytest.approx(12.0) if tried else None)
            for step in steps:
                meter.tell(step)
                clock.now_s += 4.0
            told = meter.describe(Backlog())
            assert told == WorkProgress("refining the scene", 40, 100, "step", pytest.approx(8.0))


def test_work_that_was_abandoned_or_lay_by_does_not_count(meter, clock):
    with contextlib.suppress(RuntimeError), meter.measure(Work.JUDGE):
        clock.now_s += 50.0
        raise RuntimeError
    assert meter.predict_s(Work.JUDGE) is None
    with meter.measure(Work.JUDGE):
        clock.now_s += 3.0
        work(meter, clock, Work.KEYFRAMES, 7.0)
    assert meter.predict_s(Work.JUDGE) == 3.0 and meter.predict_s(Work.KEYFRAMES) == 7.0


def test_places_that_were_left_take_their_judgement_and_their_scene(meter, clock):
    work(meter, clock, Work.JUDGE, 2.0)
    with meter.measure(Work.FINISH):
        told = meter.describe(Backlog(unjudged=1, unfinished=3))
        assert told is not None and told.left_s is None  # how long a scene takes nobody knows yet
        clock.now_s += 10.0
    with meter.measure(Work.FINISH):
        clock.now_s += 4.0
        told = meter.describe(Backlog(unjudged=1, unfinished=2))
        assert told == WorkProgress(Work.FINISH.value, 1, 3, "scene", 18.0)


def test_the_weights_of_final_scenes_are_those_that_were_measured():
    rows = json.loads((ROOT / "tests" / "bench" / "results" / "rates.json").read_text())["rates"]
    views, seconds = np.array([(row["views"], row["finalize_s"]) for row in rows]).T
    slope, base = np.polyfit(views, seconds, 1)
    ratio = slope / base / (FINAL_S_A_VIEW / FINAL_BASE_S)
    assert 0.8 < ratio < 1.25
    assert np.all(np.abs([weigh_final(n) for n in views] / seconds - 1) < 0.2)


def test_a_running_node_tells_what_it_does_and_what_is_left(config, peer):  # noqa: F811
    """The refinement counts its steps; once a second was measured, the rest is told, and status writes it."""
    steps = training.RefinementConfig(iterations=2000, checkpoints=(1000,))
    slow = replace(config, reconstruction=replace(config.reconstruction, optimize=steps), status_interval_s=0.05)
    with running(slow):
        for frame in photographs()[:3]:
            peer.server.offer(frame)
        deadline, told = time.monotonic() + PATIENCE_S, []
        while not any(each["left_s"] is not None and each["of"] == 2000 for each in told):
            assert time.monotonic() < deadline, told[-5:]
            peer.server.serve(0.01)
            heard = read_heartbeats(config.network, 0.3, only="recon")["recon"]
            if heard is not None and heard["work"] is not None:
                told.append(heard["work"])
        (line,) = [each for each in describe_heartbeat("recon", heard) if each.startswith("  now ")]
    assert "refining the scene: " in line and " of 2000 steps, about " in line and line.endswith("left")
    assert any(each["doing"] == "working in keyframes" for each in told)
