"""What went wrong is told until somebody has seen it, on one line of bounded length."""

from __future__ import annotations

from splatnode.capture.process.terminal import Problems, is_logged


def test_problems_are_told_until_seen_and_then_only_what_is_new():
    problems = Problems()
    assert str(problems) == ""
    assert problems.add("frames", "first") == 1 and problems.add("frames", "second\n\x1b") == 2
    problems.count("commands", 0, "")
    assert str(problems) == "2 frames, the last: second\\n\\x1b"
    problems.count("commands", 3, "rubbish")
    assert str(problems).endswith("; 3 commands, the last: rubbish")
    problems.mark_seen()
    assert str(problems) == ""
    problems.count("commands", 3, "rubbish")
    assert str(problems) == ""
    problems.count("commands", 4, "more")
    assert str(problems) == "1 commands, the last: more"


def test_what_is_told_is_bounded():
    problems = Problems()
    for index in range(50):
        problems.add(f"kind {index}", "x" * 5000)
    assert len(str(problems)) == 1000


def test_a_journal_is_not_filled():
    assert [count for count in range(1, 1000) if is_logged(count)] == [1, 2, 4, 8, 16, 32, 64, 128, 256, 512]
