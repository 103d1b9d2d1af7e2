"""Structured attacks on every boundary: `python -m tests.bench adversary --cases 5000000`.

Each case is drawn from the grammar of what a boundary reads (tests/support/adversary), with edge numbers in the places
of sizes, counts and coordinates. It must be read or refused with the boundary's own error. A defect is any other
exception, the end of the process, more than --patience-s seconds, more than 200 MB beyond the boundary's stated bound,
or a file written outside of the case's own folder. A case is named by its boundary and number: the seed and both of
them draw it again (--boundary NAME --first NUMBER --cases 1). Coverage is of the lines of a boundary's modules, by its
first cases; it needs the package coverage.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import logging
import multiprocessing
import os
import random
import shlex
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests.bench.node.confined import confined_to, peak_mb, silence
from tests.bench.node.coverage_of import lines_run
from tests.support.adversary.boundaries import BOUNDARIES, Boundary, attempt

BATCH = 100  # cases between two looks at the memory
BEYOND_MB = 200.0  # what a case may take beyond its boundary's stated bound
COVERED = 4000  # cases by which coverage is shown
KEPT = 20  # defects of a boundary that are described; all are counted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000, help="over all boundaries, by their shares")
    parser.add_argument("--boundary", nargs="*", choices=[each.name for each in BOUNDARIES], help="these alone")
    parser.add_argument("--first", type=int, default=0, help="number of the first case of each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--patience-s", type=float, default=60.0, help="for one batch of 100 cases")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    chosen = [each for each in BOUNDARIES if not args.boundary or each.name in args.boundary]
    whole = sum(each.share for each in chosen)
    started = time.monotonic()
    with ThreadPoolExecutor(args.processes) as pool:
        jobs = {
            each.name: pool.submit(attack, each, max(1, round(args.cases * each.share / whole)), args)
            for each in chosen
        }
        rows: dict[str, dict[str, Any]] = {}
        result: dict[str, Any] = {}
        for name, job in jobs.items():
            rows[name] = told(name, job.result())
            result = {
                "command": shlex.join(["python", "-m", "tests.bench", "adversary", *sys.argv[1:]]),
                "cases": sum(row["cases"] for row in rows.values()),
                "defects": sum(row["defects"] for row in rows.values()),
                "seconds": time.monotonic() - started,
                "boundaries": rows,
            }
            if args.out:
                args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"{result['cases']} cases, {result['defects']} defects, {result['seconds']:.0f} s")
    sys.exit(result["defects"] > 0)


def told(name: str, row: dict[str, Any]) -> dict[str, Any]:
    covered = ", ".join(f"{module.rpartition('.')[2]} {run['share']:.0%}" for module, run in row["coverage"].items())
    print(f"{name}: {row['cases']} cases, {row['read']} read, {row['defects']} defects; {covered}", flush=True)
    for defect in row["examples"]:
        print(f"  {defect}", flush=True)
    return row


def attack(boundary: Boundary, cases: int, args: argparse.Namespace) -> dict[str, Any]:
    """The boundary's row. A process that ends or hangs is a defect; another one goes on behind the case."""
    row: dict[str, Any] = {"cases": 0, "read": 0, "refused": 0, "defects": 0, "bound_mb": boundary.bound_mb}
    row |= {"peak_mb": 0.0, "growth_mb": 0.0, "examples": [], "coverage": {}}
    first, end = args.first, args.first + cases
    while first < end:
        first = _in_a_process(boundary, first, end, args, row)
    row["coverage"] = _coverage(boundary, args) if not args.first else {}
    return row


def _in_a_process(boundary: Boundary, first: int, end: int, args: argparse.Namespace, row: dict[str, Any]) -> int:
    """Runs cases until the end or until the process is lost; returns the number of the next case."""
    spawn = multiprocessing.get_context("spawn")
    receiver, sender = spawn.Pipe(duplex=False)
    process = spawn.Process(target=_work, args=(boundary.name, first, end, args.seed, sender), daemon=True)
    process.start()
    sender.close()
    at, patience_s = first, args.patience_s + 60.0  # the imports take time, too
    while True:
        said = None
        if receiver.poll(patience_s):
            with contextlib.suppress(EOFError):
                said = receiver.recv()
        if said is None:
            break
        patience_s = args.patience_s
        if "at" in said:
            at = said["at"]
            continue
        _count(row, said)
        first = said["next"]
        if first >= end:
            process.join()
            return end
    hung = process.is_alive() and process.exitcode is None
    process.kill()
    process.join()
    why = f"more than {args.patience_s:g} s" if hung else f"the process ended with {process.exitcode}"
    _count(row, {"cases": at - first + 1, "defects": [f"case {at}: {why}"]})
    return at + 1


def _count(row: dict[str, Any], said: dict[str, Any]) -> None:
    row["cases"] += said["cases"]
    row["read"] += said.get("read", 0)
    row["refused"] += said.get("refused", 0)
    row["defects"] += len(said["defects"])
    row["peak_mb"] = max(row["peak_mb"], said.get("peak_mb", 0.0))
    row["growth_mb"] = said.get("growth_mb", row["growth_mb"])
    row["examples"] += said["defects"][: KEPT - len(row["examples"])]


def _work(name: str, first: int, end: int, seed: int, sender: Any) -> None:
    """The child: batches of cases, each told when it is done; within a batch, each case is told before it is read."""
    boundary = next(each for each in BOUNDARIES if each.name == name)
    silence()
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        outside = confined_to(Path(folder))
        for number in range(-BATCH, 0):  # warms up
            _outcome(boundary, seed, number, Path(folder), [])
        at_start_mb, idle_mb = peak_mb(), peak_mb()
        for batch in range(first, end, BATCH):
            counts: collections.Counter[str] = collections.Counter()
            defects: list[str] = []
            sender.send({"at": batch})
            for number in range(batch, min(batch + BATCH, end)):
                counts[_outcome(boundary, seed, number, Path(folder), defects, sender)] += 1
            taken_mb = peak_mb() - idle_mb
            if taken_mb > boundary.bound_mb + BEYOND_MB:
                defects.append(f"cases {batch} to {batch + BATCH - 1}: {taken_mb:.0f} MB")
            idle_mb = peak_mb()
            defects += [f"cases {batch} to {batch + BATCH - 1}: {each}" for each in outside]
            outside.clear()
            counted = {"read": counts["read"], "refused": counts["refused"]}
            sender.send(
                counted
                | {"cases": counts.total(), "defects": defects, "next": min(batch + BATCH, end)}
                | {"peak_mb": taken_mb, "growth_mb": idle_mb - at_start_mb}
            )


def _outcome(boundary: Boundary, seed: int, number: int, folder: Path, defects: list[str], sender: Any = None) -> str:
    case = boundary.draw(random.Random(f"{seed} {boundary.name} {number}"))
    if sender is not None:
        sender.send({"at": number})
    try:
        return attempt(boundary, case, folder / "case")
    except Exception as error:
        defects.append(f"case {number}: {type(error).__name__}: {str(error)[:200]}")
        return "defect"


def _coverage(boundary: Boundary, args: argparse.Namespace) -> dict[str, Any]:
    """Of each module: the share of lines that cases run, in the functions that they enter, and the lines they miss."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_measure, (boundary.name, args.seed, min(COVERED, args.cases)))


def _measure(name: str, seed: int, cases: int) -> dict[str, Any]:
    boundary = next(each for each in BOUNDARIES if each.name == name)
    silence()
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder, lines_run(boundary.reader.modules) as shares:
        for number in range(cases):
            _outcome(boundary, seed, number, Path(folder), [])
    return shares


if __name__ == "__main__":
    main()
