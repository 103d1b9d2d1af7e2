"""Recordings in an hour, on one core and on all: `python -m tests.bench throughput [--recordings 8] [--rounds 2]`.

`splatnode batch` makes scenes of the built-in capture with seeds, one recording at a time and then as many at a time as
there are cores. The rounds alternate, so that what else the machine does falls on both; a machine that has other work
shows less than it can.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from splatnode.capture.process.terminal import say
from tests.bench.node.trial import expect
from tests.conftest import ROOT


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/throughput.json"))
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    seconds: dict[int, list[float]] = {1: [], cores: []}
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder) / "in", args.recordings)
        for number in range(args.rounds):
            for used, taken in seconds.items():
                taken.append(batch_s(Path(folder), f"{number}-{used}", used, args.preset, args.recordings))
                say(f"round {number + 1}, {used} at a time: {taken[-1]:.1f} s for {args.recordings} recordings")
    one, all_of_them = (statistics.median(seconds[used]) for used in (1, cores))
    result = {
        "command": shlex.join(["python", "-m", "tests.bench", "throughput", *sys.argv[1:]]),
        "processors": cores,
        "recordings": args.recordings,
        "preset": args.preset,
        "seconds": {str(used): [round(each, 1) for each in taken] for used, taken in seconds.items()},
        "times_one_core": round(one / all_of_them, 3),
    }
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    say(f"{result['times_one_core']} times the throughput of one core")


def record(folder: Path, count: int) -> None:
    """`count` folders of photographs of different places."""
    for seed in range(count):
        own = folder / f"place{seed:02d}"
        own.mkdir(parents=True)
        for frame in synthetic.stream(synthetic.Config(seed=seed)):
            (own / frame.name).write_bytes(encode_png(frame.image))


def batch_s(folder: Path, name: str, cores: int, preset: str, count: int) -> float:
    """Raises AssertionError where a recording has no scene."""
    rest = ["--out", str(folder / name), "--preset", preset, "--cores", str(cores)]
    begun = time.monotonic()
    command = [sys.executable, "-m", "splatnode", "batch", str(folder / "in"), *rest]
    found = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    taken = time.monotonic() - begun
    scenes = len(list((folder / name).glob("*/scene.ply")))
    expect(scenes == count, f"{scenes} scenes of {count} recordings: {found.stderr[-800:]}")
    return taken


if __name__ == "__main__":
    main()
