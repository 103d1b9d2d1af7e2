"""A record is one line of its own words and quoted values, whatever is in it."""

from __future__ import annotations

import io
import logging
import re
import sys
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatnode.capture.process.terminal import (
    PlainLines,
    StructuredLines,
    TimedLines,
    event,
    sanitize_output,
    use_structured_lines,
)
from tests.capture.process.test_terminal import Terminal
from tests.support.hostile import TEXTS, unprintable

VALUE = r'(?:[^\s"=]+|"(?:[^"\\]|\\.)*")'
FIELDS = rf"(?: \w+={VALUE})*"
LINE = re.compile(rf"time={VALUE} level=\w+ logger=[\w.]+ event=(\w+){FIELDS}")
JOURNAL = re.compile(rf"<[2-7]>logger=[\w.]+ event=(\w+){FIELDS}")


class Kept(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


def records_of(log_it) -> list[logging.LogRecord]:
    log, kept = logging.Logger("capture.test"), Kept()
    log.addHandler(kept)
    log_it(log)
    return kept.records


def raised(log, text):
    try:
        raise ValueError(text)
    except ValueError:
        log.exception("a step failed")


WAYS_IN = {
    "the message": lambda log, text: log.warning(text.replace("%", "%%")),
    "an argument": lambda log, text: log.warning("%s cannot be used", text),
    "a field": lambda log, text: event(log, logging.INFO, "keyframe", name=text, why=text),
    "an error in a field": lambda log, text: event(log, logging.ERROR, "spool_full", why=OSError(28, text, text)),
    "an exception": raised,
}


def assert_one_line_of_ours(line: str, pattern: re.Pattern[str], events: set[str]) -> None:
    found = pattern.fullmatch(line)
    assert found and found[1] in events, line
    assert not unprintable(line) and "\n" not in line


@pytest.mark.parametrize("way", WAYS_IN)
@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_no_text_forges_a_line_a_field_or_a_priority(way, text):
    for record in records_of(lambda log: WAYS_IN[way](log, text)):
        events = {"keyframe", "spool_full"} if "field" in way else {"log"}
        assert_one_line_of_ours(StructuredLines(journal=False).format(record), LINE, events)
        assert_one_line_of_ours(StructuredLines(journal=True).format(record), JOURNAL, events)
        first, *further = PlainLines().format(record).split("\n")
        assert not unprintable(first) and all(line.startswith("  ") and not unprintable(line) for line in further)


@given(st.text(st.characters(codec=None)))
def test_any_text_at_all(text):
    for way in WAYS_IN.values():
        for record in records_of(lambda log, way=way: way(log, text)):
            assert_one_line_of_ours(
                StructuredLines(journal=True).format(record), JOURNAL, {"log", "keyframe", "spool_full"}
            )


def test_on_a_terminal_lines_are_for_people(monkeypatch):
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    for stream, written in ((Terminal(), r"\d\d:\d\d:\d\d keyframe: name a.png"), (io.StringIO(), LINE.pattern)):
        monkeypatch.setattr(sys, "stderr", stream)
        with sanitize_output():
            use_structured_lines()
            event(root, logging.WARNING, "keyframe", name="a.png", why="")
        found = re.fullmatch(written.replace("keyframe:", "warning: keyframe:"), stream.getvalue().strip())
        assert found, stream.getvalue()
    logging.captureWarnings(False)


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_no_text_forges_a_line_for_people(text):
    for log_it in WAYS_IN.values():
        for record in records_of(lambda log, log_it=log_it: log_it(log, text)):
            first, *further = TimedLines().format(record).split("\n")
            assert re.match(r"\d\d:\d\d:\d\d ", first) and not unprintable(first)
            assert all(line.startswith("  ") and not unprintable(line) for line in further)


def test_lines_can_be_taken_apart():
    fields = {"name": "a b.png", "share": 0.123456, "why": 'say "x"\n', "waiting": 0, "empty": ""}
    (record,) = records_of(lambda log: event(log, logging.INFO, "keyframe", **fields))
    line = StructuredLines(journal=True).format(record)
    assert line == (
        '<6>logger=capture.test event=keyframe name="a b.png" share=0.1235 why="say \\"x\\"\\n" waiting=0 empty=""'
    )
    assert time.strftime("%Y-") in StructuredLines(journal=False).format(record)


def test_a_message_that_begins_like_an_event_is_a_message():
    (record,) = records_of(lambda log: log.error("%s", "event=ready checkpoint=/"))
    assert 'event=log message="event=ready checkpoint=/"' in StructuredLines(journal=False).format(record)


def test_an_endless_text_has_an_end():
    (record,) = records_of(lambda log: raised(log, "x" * 10**6))
    assert len(StructuredLines(journal=True).format(record)) < 50_000


def test_a_person_reads_an_event_in_words():
    (record,) = records_of(
        lambda log: event(log, logging.INFO, "another_place", before="a", now="b\nb", seconds=1.23456, bounds="")
    )
    assert PlainLines().format(record) == "another place: before a, now b\n  b, seconds 1.235"
