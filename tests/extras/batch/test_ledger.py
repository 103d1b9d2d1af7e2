"""Lines of a ledger that nobody wrote are left out: their recordings are run again."""

from __future__ import annotations

import json

import pytest

from splatnode.extras.batch import LEDGER, BatchRecording, Ledger, OtherBatch

ROW = {"name": "a", "source": "/a", "verdict": "OK", "message": "", "published": True, "photographs": 3}
ROW |= {"left_out": 0, "rotation_deg": 0.1, "centre_percent": 0.1, "focal_percent": 0.1, "gaussians": 10}
ROW |= {"seconds": 1.0, "reconstruction_s": 1.0, "memory_mb": 10.0, "exit_code": 0, "ended_at": 1.0}


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e400"])
def test_a_row_has_finite_numbers(tmp_path, number):
    lines = [{"batch": 1, "command": ["replay"]}, ROW]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (tmp_path / LEDGER).write_text(text.replace('"focal_percent": 0.1', f'"focal_percent": {number}'))
    with Ledger(tmp_path, ["replay"]) as ledger:
        assert ledger.verdict(BatchRecording("a", "/a")) is None
        assert list(ledger.rows([BatchRecording("a", "/a")])) == []


def test_a_row_with_finite_numbers_counts(tmp_path):
    (tmp_path / LEDGER).write_text("".join(json.dumps(line) + "\n" for line in [{"batch": 1, "command": []}, ROW]))
    with Ledger(tmp_path, []) as ledger:
        assert ledger.verdict(BatchRecording("a", "/a")) == "OK"


def test_the_options_of_another_batch_are_told_on_one_line(tmp_path):
    (tmp_path / LEDGER).write_text(json.dumps({"batch": 1, "command": ["a\nevent=forged"]}) + "\n")
    with pytest.raises(OtherBatch) as refused:
        Ledger(tmp_path, ["replay"])
    assert str(refused.value).isprintable()
