"""Faults, from kill -9 to a wrong key, done to the real processes: `python -m tests.bench faults --times 20`.

Each fault is tried so many times, each time in a node of its own that replays six small photographs. Good is a trial
after which all of them are in a finished scene, nothing lies about half written, and the exit codes are right. A fault
that cannot be done on a machine (no right to mount or to unshare) is reported as not tried.
"""

from __future__ import annotations

import argparse
import json
import random
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tests.bench.node import befallen, intruders, pauses, shortages
from tests.bench.node.trial import NotTried, Trial

FAULTS: tuple[Callable[[Trial], None], ...] = (
    befallen.kill_recon,
    befallen.kill_capture,
    befallen.camera_lost,
    befallen.late_viewer,
    befallen.second_publisher,
    befallen.slow_viewer,
    befallen.full_disk,
    befallen.clock_jump,
    befallen.half_written,
    befallen.stopped_while_exporting,
    intruders.unauthorised,
    intruders.wrong_key,
    intruders.revoked_key,
    intruders.rotated_keys,
    shortages.full_disk_under_checkpoint,
    shortages.full_disk_under_out,
    shortages.read_only_at_start,
    shortages.read_only_while_running,
    pauses.clocks_jump,
    pauses.wall_clock_jumps,
    pauses.recon_stopped_for_a_minute,
    pauses.capture_stopped_for_a_minute,
    pauses.viewer_stopped_for_a_minute,
    shortages.little_memory,
    shortages.killed_for_memory,
    shortages.few_descriptors,
    shortages.few_threads,
    pauses.recon_absent_for_an_hour,
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20, help="trials of each fault (default: 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pause", type=float, default=60.0, help="seconds for which a process is stopped")
    parser.add_argument("--only", nargs="*", choices=[fault.__name__ for fault in FAULTS], help="these faults")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/faults.json"))
    args = parser.parse_args()
    command, rows = _so_far(args.out, args.only or ())
    for index in range(args.times):
        for fault in (each for each in FAULTS if not args.only or each.__name__ in args.only):
            row = rows.setdefault(fault.__name__, {"tried": 0, "good": 0, "failures": [], "seconds": []})
            started = time.monotonic()
            with tempfile.TemporaryDirectory() as folder:
                trial = Trial(Path(folder), random.Random(f"{args.seed} {fault.__name__} {index}"), args.pause)
                try:
                    fault(trial)
                except NotTried as reason:
                    row["not_tried"] = str(reason)
                    continue
                except (AssertionError, subprocess.TimeoutExpired) as error:
                    logs = {path.name: path.read_text()[-3000:] for path in Path(folder).glob("*/*.log")}
                    row["failures"].append({"trial": index, "why": str(error), "logs": logs})
                else:
                    row["good"] += 1
            row["tried"] += 1
            row["seconds"].append(round(time.monotonic() - started, 1))
            print(f"{fault.__name__} {index}: {row['good']} of {row['tried']} good", flush=True)
            args.out.write_text(json.dumps({"command": command, "faults": rows}, indent=1) + "\n")
    sys.exit(any(row["good"] < row["tried"] for row in rows.values()))


def _so_far(out: Path, only: Sequence[str]) -> tuple[str, dict[str, dict[str, Any]]]:
    """The command, and the rows that it leaves alone: with --only the others stay."""
    command = shlex.join(["python", "-m", "tests.bench", "faults", *sys.argv[1:]])
    if not only or not out.exists():
        return command, {}
    before = json.loads(out.read_text())
    return f"{before['command']}; {command}", {name: row for name, row in before["faults"].items() if name not in only}
