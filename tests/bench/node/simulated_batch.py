"""The driver's process of two benchmarks: `python -m tests.bench.node.simulated_batch FOLDER COUNT [ADDRESS SLEEP]`.

With the address of a Ray cluster, it runs the recordings there; each sleeps for up to so many seconds.

It imports what the verb `batch` imports and little else, so that its memory is that of a real driver.
"""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from splatnode.extras.batch import BatchRecording
from splatnode.extras.batch.command import run_batch
from tests.support.recordings import GOOD, REFUSED, options, simulated

OUT, TALLY = "out", "tally"  # in the folder: the batch, and a line for each time that a recording began
LONGEST_SLEEP_S = 0.02
MOST_CORES = 2
_ENDS = {"OK": (GOOD, 0.85), "NO_OVERLAP": (REFUSED, 0.1), "failed": ("exit 9", 0.04), "killed": ("kill -9 $$", 0.01)}


def recordings(folder: Path, count: int) -> list[BatchRecording]:
    return [BatchRecording(f"{number:06d}", str(folder / f"{number:06d}")) for number in range(count)]


def end_of(recording: BatchRecording, longest_sleep_s: float = LONGEST_SLEEP_S) -> tuple[str, str, float]:
    """What it comes to, the shell's command for that, and for how long it sleeps before: drawn from its name alone."""
    chance = random.Random(recording.name)
    (name,) = chance.choices(list(_ENDS), [share for _, share in _ENDS.values()])
    return name, _ENDS[name][0], chance.uniform(0, longest_sleep_s)


def work(longest_sleep_s: float, recording: BatchRecording, folder: Path) -> Sequence[str]:
    _, command, sleep_s = end_of(recording, longest_sleep_s)
    tally = Path(recording.source).with_name(TALLY)
    told = f"echo {recording.name} >> '{tally}'; sleep {sleep_s:.3f}; {command}"
    return simulated(BatchRecording(recording.name, told), folder)


def main() -> None:
    """Runs all recordings that have not come to an end."""
    folder, count = Path(sys.argv[1]), int(sys.argv[2])
    address, sleep_s = (sys.argv[3], float(sys.argv[4])) if len(sys.argv) > 3 else (None, LONGEST_SLEEP_S)
    cores = None if address else min(MOST_CORES, len(os.sched_getaffinity(0)))
    args = options(folder / OUT, resume=True, cores=cores, ray=address)
    sys.exit(run_batch(args, recordings(folder, count), partial(work, sleep_s), ["simulation"]))


if __name__ == "__main__":
    main()
