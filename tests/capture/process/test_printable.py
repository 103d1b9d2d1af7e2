"""No character that drives a terminal, forges a line or turns the writing direction passes."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatnode.capture.process.text import LONGEST_LINE, is_printable, sanitize_lines, sanitize_text


@pytest.mark.parametrize(
    ("raw", "shown"),
    [
        ("view_000.png", "view_000.png"),
        ("Küche 3 (日本).jpg", "Küche 3 (日本).jpg"),
        ("a\nevent=keyframe", "a\\nevent=keyframe"),
        ("\x1b]0;title\x07", "\\x1b]0;title\\x07"),
        ("gpj.\u202etxt", "gpj.\\u202etxt"),
        ("a\u2028b\x85c", "a\\u2028b\\x85c"),
        ("\udcff.png", "\\udcff.png"),
    ],
)
def test_what_cannot_be_shown_is_an_escape(raw, shown):
    assert sanitize_text(raw) == shown


@given(st.text(st.characters(codec=None), max_size=300))
def test_nothing_but_printable_characters_passes_and_a_second_time_changes_nothing(text):
    shown = sanitize_text(text, 255)
    assert len(shown) <= 255
    assert not any(unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp") for letter in shown)
    assert sanitize_text(shown, 255) == shown and is_printable(shown, 255)


def test_a_long_text_says_that_its_end_is_left_out():
    assert sanitize_text("x" * 300, 255) == "x" * 254 + "…"


def test_lines_are_each_printable_and_as_long_as_people_read():
    shown = sanitize_lines("a\x1b[2J\n" + "b" * 100_000)
    first, second = shown.split("\n")
    assert first == "a\\x1b[2J" and second == "  " + "b" * (LONGEST_LINE - 1) + "…"
