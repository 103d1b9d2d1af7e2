"""What moved is told where it is more than a few percent of a photograph."""

from __future__ import annotations

from splatnode.recon.result.snapshot import describe_moving


def test_little_is_not_told():
    assert describe_moving({}) == "" and describe_moving({"a.jpg": 0.02}) == ""


def test_the_sentence_has_the_shares_that_are_worth_telling():
    told = describe_moving({"a.jpg": 0.02, "b.jpg": 0.051, "c.jpg": 0.3})
    assert told == "left out of 2 photographs: what moved between them, 5% to 30% of each (report.json names them)"
    assert "a photograph: what moved between them, 30% of each" in describe_moving({"c.jpg": 0.3})
