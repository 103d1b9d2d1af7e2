"""What the page says beside the picture, in the words of the window's panel."""

from __future__ import annotations

from typing import Any

from splatnode.capture.process.printable import sanitize_text
from splatnode.recon.result.verdict import Code
from splatnode.viewer import words
from splatnode.viewer.session import Session

_MOST_DROPPED = 200  # photographs that are listed
_MOST_VIEWS = 100  # whose share of confirmed depth is listed
_LONGEST = 2000  # characters of a line


def describe_session(session: Session) -> dict[str, Any]:
    """Headings and their lines, every one printable; `good`: whether the verdict is."""
    moment, age = session.moment, session.source.age_s
    if moment is None:
        return {"good": None, "state": words.waiting_line(age), "verdict": [], "sections": []}
    snapshot, analysis = moment.snapshot, session.analysis()
    sections = [
        ("Next view", [words.advice_line(analysis.advice if analysis else None, moment)]),
        ("How well it is known", [*words.bounds_lines(moment), *words.depth_lines(moment)]),
        ("Depth that other views confirm", words.view_depth_lines(moment, _MOST_VIEWS)),
        ("Places", words.place_lines(moment)),
        ("What there is", words.count_lines(moment)),
        (f"Photographs left out: {len(snapshot.dropped)}", words.rejection_lines(moment, _MOST_DROPPED)),
    ]
    kind = "final" if snapshot.final else "provisional: the scene is still being made"
    return {
        "good": snapshot.verdict.code is Code.OK,
        "state": f"{words.feed_line(age, snapshot.final)}; {kind}" if age is not None else words.feed_line(age, True),
        "verdict": [_line(line) for line in words.verdict_lines(moment)],
        "sections": [[heading, [_line(line) for line in lines]] for heading, lines in sections if lines],
    }


def _line(text: str) -> str:
    return sanitize_text(text, _LONGEST)
