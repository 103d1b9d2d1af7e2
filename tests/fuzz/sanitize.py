"""The core under sanitizers, with random and hostile numbers: bundle, PatchMatch, partition and matching.

`python -m tests.fuzz.sanitize --seconds 60 --seed 1` prints what it came to as JSON, and ends with 1 after a defect. A
round depends on its number and the seed alone, so that a defect comes again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from splatnode.recon.core.compile import FLAGS
from tests.conftest import ROOT

CORE = ROOT / "recon" / "core"
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer", "-O1", "-g")
_CASTS = "-fsanitize=float-cast-overflow"  # which `undefined` leaves out
_PARTS = (
    "bundle",
    "patchmatch",
    "patchmatch_check",
    "patchmatch_support",
    "partition",
    "match",
    "match_near",
    "threads",
)
_SOURCES = (*(CORE / f"{name}.cpp" for name in _PARTS), ROOT / "tests" / "native" / "fuzz_core.cpp")
_MOST_DEFECTS = 20  # after which nothing new is to be learnt
_REPORT = 2000  # characters of a sanitizer's report that are kept


def main(seconds: float, seed: int) -> dict[str, Any]:
    """Rounds for so many seconds, compiling not counted: calls by kind, and defects, each with its round and report.

    Raises RuntimeError where there is no compiler with sanitizers.
    """
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder))
        return fuzz(program, seconds, seed)


def build(folder: Path, flags: Sequence[str] = ()) -> Path:
    """The program of fuzz_core.cpp with sanitizers in `folder`. Raises RuntimeError where it cannot be made."""
    compiler = shutil.which("g++")
    if compiler is None:
        raise RuntimeError("g++ is needed, with its sanitizers' libraries. Run: apt-get install g++")
    every = [*FLAGS, *SANITIZERS, _CASTS, *flags]

    def compile_one(source: Path) -> str:
        output = str(folder / f"{source.stem}.o")
        _run([compiler, *every, f"-I{CORE}", "-c", str(source), "-o", output])
        return output

    with ThreadPoolExecutor(max_workers=2) as pool:
        objects = list(pool.map(compile_one, _SOURCES))
    program = folder / "fuzz_core"
    _run([compiler, *every, *objects, "-o", str(program)])
    return program


def fuzz(program: Path, seconds: float, seed: int) -> dict[str, Any]:
    """As `main`, with a program that is there."""
    counts: Counter[str] = Counter()
    defects: list[dict[str, Any]] = []
    ends, first = time.monotonic() + seconds, 0
    while (left := ends - time.monotonic()) > 0 and len(defects) < _MOST_DEFECTS:
        command = [str(program), f"{left:.3f}", str(seed), str(first)]
        environment = {**os.environ, "UBSAN_OPTIONS": "print_stacktrace=1"}
        run = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment)
        told = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{") and line.endswith("}")]
        begun = [each for each in told if "round" in each]
        counts.update(each["kind"] for each in begun)
        if run.returncode == 0:
            break
        last = begun[-1] if begun else {"round": first, "kind": "start"}
        defects.append({**last, "seed": seed, "ended": run.returncode, "report": run.stderr[:_REPORT]})
        first = last["round"] + 1
    return {"seconds": seconds, "seed": seed, "calls": dict(counts), "defects": defects}


def _run(command: Sequence[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"{command[0]} ended with {result.returncode}: {result.stderr[-_REPORT:]}")


def _command() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.sanitize", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of rounds")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    found = main(args.seconds, args.seed)
    print(json.dumps(found, indent=1))
    return 1 if found["defects"] else 0


if __name__ == "__main__":
    sys.exit(_command())
