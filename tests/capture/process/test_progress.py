"""What is being done is told in place on a terminal, and in plain lines elsewhere."""

from __future__ import annotations

import contextlib
import io
import sys
import time

import pytest

from splatnode.capture.process import terminal
from splatnode.capture.process.terminal import (
    ProgressPrinter,
    ProgressStep,
    RemainingTime,
    add_remaining_time,
    ignore_progress,
    report_items,
    sanitize_output,
    show_progress,
    show_waiting,
)
from tests.capture.process.test_terminal import Terminal


@pytest.fixture
def printed(monkeypatch):
    """What two steps with a finding between them print on standard output and error of this kind."""

    def run(stream: io.StringIO) -> str:
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "stderr", stream)
        with sanitize_output():
            tell = ProgressPrinter()
            assert list(report_items("ab", tell, "reading", 2, "photograph")) == ["a", "b"]
            tell("1 of 2: a is sharp")
            tell(ProgressStep("thinking"))
        return stream.getvalue()

    return run


def test_where_there_is_no_terminal_each_step_is_one_plain_line(printed):
    assert printed(io.StringIO()) == "reading: 2 photographs\n1 of 2: a is sharp\nthinking\n"


def test_on_a_terminal_a_step_is_shown_in_place_with_its_seconds(printed, monkeypatch):
    monkeypatch.setattr(terminal.time, "monotonic", lambda: 7.0)
    reading = "\rreading: 1 of 2 photographs (0 s)\rreading: 2 of 2 photographs (0 s)\n"
    assert printed(Terminal()) == f"{reading}1 of 2: a is sharp\n\rthinking (0 s)\n"


def test_a_terminal_is_written_to_ten_times_a_second_at_most_and_at_the_end_of_a_step(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    now = iter([0.0, 0.05, 0.15, 0.16, 0.17])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
    with sanitize_output():
        tell = ProgressPrinter()
        for done in range(1, 6):
            tell(ProgressStep("refining", done, 5, "step"))
    assert [part.split()[1] for part in screen.getvalue().split("\r")[1:]] == ["1", "3", "5"]


@pytest.mark.parametrize(
    ("done", "of", "now_s", "said"),
    [
        (1, 4, 0.5, "(0 s)"),  # too early to tell
        (1, 4, 2.0, "(2 s, about 6 s left)"),
        (3, 4, 90.0, "(90 s, about 30 s left)"),
        (1, 4, 100.0, "(100 s, about 5 min left)"),
        (4, 4, 8.0, "(8 s)"),  # nothing is left
        (3, 0, 8.0, "(8 s)"),  # nobody knows how many there are
    ],
)
def test_a_step_tells_how_long_the_rest_will_take(done, of, now_s, said, monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    now = iter([0.0, now_s])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
    with sanitize_output():
        tell = ProgressPrinter()
        tell(ProgressStep("refining", 0, of, "step"))
        tell(ProgressStep("refining", done, of, "step"))
    assert screen.getvalue().split("\r")[-1].strip().endswith(said)


def test_a_step_that_ends_early_leaves_no_time_behind(monkeypatch):
    with shown_on_terminal(monkeypatch, tick_s=60.0) as screen:
        now = iter([0.0, 5.0, 5.0, 5.0])
        monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
        tell = ProgressPrinter()
        tell(ProgressStep("matching", 1, 4, "pair"))
        tell(ProgressStep("matching", 2, 4, "pair"))
        tell("found")
    assert screen.getvalue().endswith("(5 s, about 5 s left)\rmatching: 2 of 4 pairs (5 s)                \nfound\n")


@contextlib.contextmanager
def shown_on_terminal(monkeypatch, tick_s=0.01):
    """A terminal that shows what standard output and error get, on which a second is `tick_s`."""
    screen = Terminal()
    monkeypatch.setattr(terminal, "_TICK_S", tick_s)
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setattr(sys, "stderr", screen)
    with sanitize_output():
        yield screen


def shown_within(screen: Terminal, text: str, limit_s: float = 10.0) -> bool:
    until = time.monotonic() + limit_s
    while text not in screen.getvalue() and time.monotonic() < until:
        time.sleep(0.01)
    return text in screen.getvalue()


def test_the_seconds_of_a_step_go_on_while_it_is_not_heard_of(monkeypatch):
    with shown_on_terminal(monkeypatch) as screen, show_progress() as tell:
        tell(ProgressStep("thinking"))
        assert shown_within(screen, "\rthinking (0 s)\rthinking (0 s)")
        tell("found")
        after = len(screen.getvalue())
        time.sleep(0.1)
        assert len(screen.getvalue()) == after  # what was printed since stands there
        tell(ProgressStep("counting", 2, 2, "sheep"))
        after = len(screen.getvalue())
        time.sleep(0.1)
        assert len(screen.getvalue()) == after  # it is done


def test_with_quiet_nobody_is_told(monkeypatch):
    with shown_on_terminal(monkeypatch) as screen, show_progress(quiet=True) as tell:
        tell(ProgressStep("thinking"))
        tell("found")
    assert not screen.getvalue()


def test_what_is_waited_for_is_shown_meanwhile_and_then_taken_away(monkeypatch):
    with shown_on_terminal(monkeypatch) as screen:
        with show_waiting("loading"):
            assert shown_within(screen, "loading (0 s)")
        print("there")
    assert screen.getvalue().endswith("\r" + " " * len("loading (0 s)") + "\rthere\n")


def test_what_is_soon_there_is_not_waited_for(monkeypatch):
    with shown_on_terminal(monkeypatch, tick_s=60.0) as screen, show_waiting("loading"):
        pass
    assert not screen.getvalue()


@pytest.mark.parametrize(
    ("step", "said", "announced"),
    [
        (ProgressStep("matching", 3, 10, "pair"), "matching: 3 of 10 pairs", "matching: 10 pairs"),
        (ProgressStep("choosing", 7, 0, "frame"), "choosing: 7 frames", "choosing"),
        (ProgressStep("matching", 1, 1, "pair"), "matching: 1 of 1 pair", "matching: 1 pair"),
        (ProgressStep("writing"), "writing", "writing"),
    ],
)
def test_a_step_in_words(step, said, announced):
    assert (str(step), step.announcement) == (said, announced)


def test_the_rest_is_told_by_the_newer_half_and_not_before_a_second_was_measured():
    remaining = RemainingTime()

    def left(done: int, now_s: float, doing: str = "refining") -> float | None:
        return remaining.estimate(ProgressStep(doing, done, 100, "step"), now_s)

    assert left(0, 0.0) is None and left(1, 0.9) is None  # nothing is known yet
    assert left(10, 10.0) == pytest.approx(91.0)  # nine in 9.1 s
    assert left(20, 11.0) == pytest.approx(8.0)  # faster than it began: ten in the last second
    assert left(20, 13.0) == pytest.approx(6.0)  # it goes on while nothing is heard
    assert left(20, 99.0) == 0.0
    assert left(100, 100.0) is None  # nothing is left
    assert left(5, 101.0) is None and left(6, 101.5, "another") is None  # each step is measured by itself


def test_whoever_listens_hears_the_rest_of_a_step_and_lines_as_they_are(monkeypatch):
    heard: list[ProgressStep | str] = []
    now = iter([0.0, 2.0])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
    tell = add_remaining_time(heard.append)
    tell(ProgressStep("refining", 100, 500, "step"))
    tell("a line")
    tell(ProgressStep("refining", 200, 500, "step"))
    first, line, second = heard
    assert isinstance(first, ProgressStep) and first.left_s is None and line == "a line"
    assert isinstance(second, ProgressStep) and second.left_s == pytest.approx(6.0)
    assert second.sentence == "refining: 200 of 500 steps, about 6 s left"
    assert add_remaining_time(ignore_progress) is ignore_progress


def test_where_there_is_no_terminal_a_long_step_says_every_ten_seconds_how_far_it_is(monkeypatch):
    stream, now = io.StringIO(), iter([0.0, 0.0, 9.0, 9.0, 12.0, 12.0, 20.0, 20.0, 24.0, 24.0])
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
    with sanitize_output():
        tell = add_remaining_time(ProgressPrinter())
        for done in (0, 90, 120, 200, 240):
            tell(ProgressStep("refining", done, 500, "step"))
    told = [
        "refining: 500 steps",
        *(f"refining: {done} of 500 steps, about {left} s left" for done, left in ((120, 38), (240, 26))),
    ]
    assert stream.getvalue().splitlines() == told
