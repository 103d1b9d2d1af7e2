"""Every write interrupted, at every point: `./run fuzz --only writes`.

First an undisturbed run lists its points: each call that changes the disk. Then one run for each of them and each kind
of fault (`tests/support/disk_faults.py`). Good is a run after which what was there before is whole, or what was to
come, whose promises are kept, and whose work can be done again without help.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from tests.conftest import ROOT
from tests.support.disk_faults import compiled, environment, is_loaded

_OWN_NAME = "tests.fuzz.writes"
_ENDS_S = 600.0  # after the time is up, for the run that is under way


def main(seconds: float, seed: int) -> dict[str, Any]:
    """All pieces in an order by chance, as many as there is time for; a row each.

    They run in a process whose disk fails, which is loaded before anything else.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "rows.json")
        command = [sys.executable, "-m", _OWN_NAME, "--seconds", str(seconds), "--seed", str(seed), "--out", str(out)]
        run = subprocess.run(command, cwd=ROOT, stdout=sys.stderr, timeout=seconds + _ENDS_S)
        if not out.exists():
            return {"defects": 1, "problem": f"{shlex.join(command)} ended with {run.returncode} and told nothing"}
        return json.loads(out.read_text())


def run_apart() -> None:
    """The process that `main` starts, and anybody who wants some of the pieces."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", metavar="PIECE", help="these pieces")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if not is_loaded():
        _again_with_the_library()
    rows = measured(args.only, args.seconds, args.seed)
    runs = sum(sum(row["runs"].values()) for row in rows.values())
    failures = sum(len(row["failures"]) for row in rows.values())
    told = {"points": sum(row["points"] for row in rows.values()), "runs": runs, "defects": failures, "pieces": rows}
    args.out.write_text(json.dumps(told, indent=1) + "\n")
    sys.exit(failures > 0)


def _again_with_the_library() -> None:
    """Starts this program anew, with the disk that fails, which is loaded before anything else."""
    with tempfile.TemporaryDirectory() as folder:
        library = compiled(Path(folder))
        command = [sys.executable, "-m", _OWN_NAME, *sys.argv[1:]]
        sys.exit(os.spawnve(os.P_WAIT, sys.executable, command, os.environ | environment(library)))


def measured(only: list[str] | None, seconds: float, seed: int) -> dict[str, dict[str, Any]]:
    """A row for each piece: its points, the runs, how many were good, and what was wrong with the others."""
    from tests.fuzz.interrupted import outcomes, points_of
    from tests.fuzz.pieces import PIECES
    from tests.fuzz.whole_runs import RUNS

    until = time.monotonic() + seconds
    pieces = [piece for piece in (*PIECES, *RUNS) if not only or piece.name in only]
    if seconds < float("inf"):
        random.Random(seed).shuffle(pieces)
    rows = {}
    for piece in pieces:
        if time.monotonic() > until:
            break
        started = time.monotonic()
        found = points_of(piece)
        runs: Counter[str] = Counter()
        failures = []
        for point, kind, wrong in outcomes(piece, found):
            runs[kind] += 1
            if wrong:
                failures.append({"point": str(point), "kind": kind, "wrong": wrong})
            if time.monotonic() > until:
                break
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


if __name__ == "__main__":
    run_apart()
