"""Many recordings, simulated: `python -m tests.bench batch_simulation --recordings 10000`.

The engine, the ledger, the tables and the page of `splatnode batch` are the real ones; in place of `splatnode replay` a
shell sleeps for up to 20 ms and then leaves a report, refuses, fails or is killed, at random. The driver is a process
of its own, which is killed with -9 `--kills` times, each time after a twentieth of the recordings, and then goes on
with --resume until the end. Counted: how often each recording began, what each has left, and what the driver takes of
memory and of the processor in the last and longest of its lives.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from splatnode.extras.batch import FAILED, LEDGER
from splatnode.extras.batch.command import CSV, EXIT_SOME_FAILED
from tests.bench.node.simulated_batch import OUT, TALLY, end_of, recordings
from tests.bench.node.trial import expect
from tests.conftest import ROOT
from tests.support.node import memory_mb, processor_s

_PART = 20  # the driver is killed after each such part of the recordings
_LOOK_EVERY_S = 0.05
_WARM = 0.1  # of the recordings of a life: the driver's memory after them is compared with that at its end
_PATIENCE_S = 3600.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/batch_simulation.json"))
    args = parser.parse_args()
    result: dict[str, Any] = {"command": shlex.join(["python", "-m", "tests.bench", "batch_simulation", *sys.argv[1:]])}
    with tempfile.TemporaryDirectory() as folder:
        result |= simulate(Path(folder), args.recordings, args.kills)
    print(json.dumps(result))
    args.out.write_text(json.dumps(result, indent=1) + "\n")


def simulate(folder: Path, count: int, kills: int) -> dict[str, Any]:
    """The row of one simulation. Raises AssertionError where the driver ends by itself, or not at all."""
    out, tally, began_s = folder / OUT, folder / TALLY, time.monotonic()
    for kill in range(1, kills + 1):
        _live(folder, count, until=kill * count // _PART)
    last = _live(folder, count, until=None)
    began = Counter(tally.read_text().split())
    expected = {each.name: end_of(each)[0] for each in recordings(folder, count)}
    found = verdicts(out)
    return {
        "processors": len(os.sched_getaffinity(0)),
        "recordings": count,
        "kills_of_the_driver": kills,
        "began": sum(began.values()),
        "repeated": sum(began.values()) - len(began),
        "repeated_percent": round(100 * (sum(began.values()) - len(began)) / count, 3),
        "rows": len(found),
        "as_expected": sum(found.get(name) == verdict(end) for name, end in expected.items()),
        "verdicts": dict(Counter(found.values())),
        "results_whole": sum((out / name / "report.json").is_file() for name in expected),
        "hidden_files_left": sum(
            path.name.startswith(".") and path.name.endswith(".partial") for path in out.iterdir()
        ),
        "seconds": round(time.monotonic() - began_s, 1),
        "last_life": last,
    }


def _live(folder: Path, count: int, until: int | None) -> dict[str, Any]:
    """One life of the driver: to `until` rows, and then it is killed; None: to its end."""
    ledger, started_s = folder / OUT / LEDGER, time.monotonic()
    before = lines(ledger)
    command = [sys.executable, "-m", "tests.bench.node.simulated_batch", str(folder), str(count)]
    with (folder / "driver.log").open("ab") as log:
        driver = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
    seen: list[tuple[int, float]] = []  # recordings that have ended in this life, MB
    used_s = 0.0
    try:
        while driver.poll() is None:
            expect(time.monotonic() < started_s + _PATIENCE_S, "the driver does not come to its end")
            rows = lines(ledger)
            if until is not None and rows >= until:
                break
            try:
                seen.append((rows - before, memory_mb(driver.pid)))
                used_s = processor_s(driver.pid)
            except (OSError, IndexError):  # it has just ended
                break
            time.sleep(_LOOK_EVERY_S)
        if until is not None:
            expect(driver.poll() is None, f"the driver ended by itself: {(folder / 'driver.log').read_text()[-500:]}")
            driver.send_signal(signal.SIGKILL)
    except BaseException:
        driver.kill()
        raise
    finally:
        code = driver.wait()
    if until is not None:
        return {}
    expect(code == EXIT_SOME_FAILED, f"exit code {code}: {(folder / 'driver.log').read_text()[-500:]}")
    todo = count - before
    running = [mb for rows, mb in seen if _WARM * todo <= rows < todo]
    expect(len(running) > 1, "too few recordings for a look at the driver's memory")
    return {
        "recordings": todo,
        "looks": len(seen),
        "memory_mb_after_a_tenth": round(running[0], 2),
        "memory_mb_at_the_last_recording": round(running[-1], 2),
        "memory_mb_at_most_while_running": round(max(running), 2),
        "memory_mb_at_most_with_the_tables": round(max(mb for _, mb in seen), 2),
        "driver_processor_ms_per_recording": round(1000 * used_s / todo, 2),
        "seconds": round(time.monotonic() - started_s, 1),
    }


def verdict(end: str) -> str:
    return FAILED if end in ("failed", "killed") else end


def verdicts(out: Path) -> dict[str, str]:
    rows = (out / CSV).read_text(encoding="utf-8").splitlines()
    expect(len({line.split(",")[0] for line in rows}) == len(rows), "a recording has two rows")
    place = rows[0].split(",").index("verdict")
    return {line.split(",")[0]: line.split(",")[place] for line in rows[1:]}


def lines(ledger: Path) -> int:
    """Of recordings: the first line says what the batch is."""
    return max(0, ledger.read_bytes().count(b"\n") - 1) if ledger.exists() else 0


if __name__ == "__main__":
    main()
