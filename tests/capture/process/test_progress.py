"""What is being done is told in place on a terminal, and in plain lines elsewhere."""

from __future__ import annotations

import io
import sys

import pytest

from splatnode.capture.process import progress
from splatnode.capture.process.progress import Step, Told, counted
from splatnode.capture.process.terminal import shown_as_text
from tests.capture.process.test_terminal import Terminal


@pytest.fixture
def printed(monkeypatch):
    """What two steps with a finding between them print on standard output and error of this kind."""

    def run(stream: io.StringIO) -> str:
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "stderr", stream)
        with shown_as_text():
            tell = Told()
            assert list(counted("ab", tell, "reading", 2, "photograph")) == ["a", "b"]
            tell("1 of 2: a is sharp")
            tell(Step("thinking"))
        return stream.getvalue()

    return run


def test_where_there_is_no_terminal_each_step_is_one_plain_line(printed):
    assert printed(io.StringIO()) == "reading: 2 photographs\n1 of 2: a is sharp\nthinking\n"


def test_on_a_terminal_a_step_is_shown_in_place_with_its_seconds(printed, monkeypatch):
    monkeypatch.setattr(progress.time, "monotonic", lambda: 7.0)
    reading = "\rreading: 1 of 2 photographs (0 s)\rreading: 2 of 2 photographs (0 s)\n"
    assert printed(Terminal()) == f"{reading}1 of 2: a is sharp\n\rthinking (0 s)\n"


def test_a_terminal_is_written_to_ten_times_a_second_at_most_and_at_the_end_of_a_step(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    now = iter([0.0, 0.05, 0.15, 0.16, 0.17])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    with shown_as_text():
        tell = Told()
        for done in range(1, 6):
            tell(Step("refining", done, 5, "step"))
    assert [part.split()[1] for part in screen.getvalue().split("\r")[1:]] == ["1", "3", "5"]


@pytest.mark.parametrize(
    ("step", "said", "announced"),
    [
        (Step("matching", 3, 10, "pair"), "matching: 3 of 10 pairs", "matching: 10 pairs"),
        (Step("choosing", 7, 0, "frame"), "choosing: 7 frames", "choosing"),
        (Step("matching", 1, 1, "pair"), "matching: 1 of 1 pair", "matching: 1 pair"),
        (Step("writing"), "writing", "writing"),
    ],
)
def test_a_step_in_words(step, said, announced):
    assert (str(step), step.announced) == (said, announced)
