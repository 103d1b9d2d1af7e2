"""Every write interrupted, at every point: `python -m tests.bench writes`.

First an undisturbed run lists its points: each call that changes the disk. Then one run for each of them and each kind
of fault (`tests/support/disk_faults.py`). Good is a run after which what was there before is whole, or what was to
come, whose promises are kept, and whose work can be done again without help.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from tests.support.disk_faults import compiled, environment, is_loaded


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", metavar="PIECE", help="these pieces")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/writes.json"))
    args = parser.parse_args()
    if not is_loaded():
        _again_with_the_library()
    rows = measured(args.only)
    command = shlex.join(["python", "-m", "tests.bench", "writes", *sys.argv[1:]])
    args.out.write_text(json.dumps({"command": command, "pieces": rows}, indent=1) + "\n")
    sys.exit(any(row["failures"] for row in rows.values()))


def _again_with_the_library() -> None:
    """Starts this program anew, with the disk that fails, which is loaded before anything else."""
    with tempfile.TemporaryDirectory() as folder:
        library = compiled(Path(folder))
        command = [sys.executable, "-m", "tests.bench", "writes", *sys.argv[1:]]
        sys.exit(os.spawnve(os.P_WAIT, sys.executable, command, os.environ | environment(library)))


def measured(only: list[str] | None) -> dict[str, dict[str, Any]]:
    """A row for each piece: its points, the runs, how many were good, and what was wrong with the others."""
    from tests.bench.node.interrupted import outcomes, points_of
    from tests.bench.node.pieces import PIECES
    from tests.bench.node.whole_runs import RUNS

    rows = {}
    for piece in (*PIECES, *RUNS):
        if only and piece.name not in only:
            continue
        started = time.monotonic()
        found = points_of(piece)
        runs: Counter[str] = Counter()
        failures = []
        for point, kind, wrong in outcomes(piece, found):
            runs[kind] += 1
            if wrong:
                failures.append({"point": str(point), "kind": kind, "wrong": wrong})
        rows[piece.name] = {
            "points": len(found),
            "runs": dict(runs),
            "good": runs.total() - len(failures),
            "failures": failures,
            "seconds": round(time.monotonic() - started, 1),
            "calls": [str(point) for point in found],
        }
        print(f"{piece.name}: {len(found)} points, {runs.total() - len(failures)} of {runs.total()} good", flush=True)
    return rows
