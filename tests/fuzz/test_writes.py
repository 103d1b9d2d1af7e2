"""Spool, checkpoint, results, recordings and keys are whole after a fault at any of their writes."""

from __future__ import annotations

import json
import subprocess
import sys

from tests.conftest import ROOT

PIECES = ("spool", "checkpoint", "first result", "new result", "refused result", "export", "recording", "keys")


def test_a_fault_at_any_write_leaves_the_old_or_the_new_and_needs_no_hand(tmp_path):
    out = tmp_path / "writes.json"
    command = [sys.executable, "-m", "tests.fuzz.writes", "--out", str(out), "--only", *PIECES]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert out.exists(), ran.stderr
    rows = json.loads(out.read_text())["pieces"]
    assert set(rows) == set(PIECES)
    for name, row in rows.items():
        assert row["failures"] == [], name
        assert row["points"] >= 5 and row["good"] >= 3 * row["points"]
