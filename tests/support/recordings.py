"""Recordings whose reconstruction is simulated, by a shell that writes a report, waits, fails or takes memory."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from splatnode.extras.batch import BatchRecording

REPORT = {
    "verdict": {"code": "OK", "message": "All 3 photographs were placed.", "advice": "", "publishable": True},
    "bounds": {"rotation_deg": 0.1234, "centre_percent": 1.5, "focal_percent": 2.0, "centre": 0.1, "axes": []},
    "seconds": {"total": 0.5, "matching": 0.1},
    "frames_used": ["a", "b", "c"],
    "frames_dropped": [],
    "num_gaussians": 1000,
    "peak_rss_mb": 12.5,
}
REFUSAL = {
    **REPORT,
    "verdict": {"code": "NO_OVERLAP", "message": "They share nothing.", "publishable": False},
    "bounds": None,
}


def simulated(recording: BatchRecording, folder: Path) -> Sequence[str]:
    """Runs the shell command that is the recording's source; its folder is $OUT, and the report `$REPORT`."""
    told = f"OUT='{folder}' REPORT='{json.dumps(REPORT)}' REFUSAL='{json.dumps(REFUSAL)}'"
    return ["sh", "-c", f"{told}; {recording.source}"]


GOOD = 'mkdir "$OUT" && printf %s "$REPORT" > "$OUT/report.json"'
REFUSED = 'mkdir "$OUT" && printf %s "$REFUSAL" > "$OUT/report.json"; exit 65'


def options(out: Path, **changed: object) -> argparse.Namespace:
    """What `run_batch` takes of the command line."""
    plain = {"resume": False, "retry": False, "cores": 1, "max_memory": None, "timeout_s": None, "json": False}
    plain |= {"write_back": False, "in_place": False, "ray": None, "results": None}
    return argparse.Namespace(**{"out": out, **plain, **changed})
