"""Trials in a core-hour: `python -m tests.bench campaign [--rows 3,4,5,13] [--seeds 30]`.

`splatnode robustness` tries short rows of the matrix on the built-in places, one at a time on one core. The processor
time is that of the command with all that it starts: the photographs of each trial, the trials, the tables. So it is the
same on a machine that has other work, where the command itself takes longer. The places are there before.
"""

from __future__ import annotations

import argparse
import json
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.report import describe_processor
from splatnode.extras.evaluate.stability.perturbations import load_trial_scenes
from tests.bench.node.trial import expect
from tests.conftest import ROOT


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default="3,4,5,13")
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/campaign.json"))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        load_trial_scenes((), Path(folder))
        rest = ["--rows", args.rows, "--seeds", str(args.seeds), "--cores", "1", "--out", folder]
        took_s, processor_s = campaign_s([sys.executable, "-m", "splatnode", "robustness", *rest])
        trials = json.loads(Path(folder, "stability.json").read_text())["trials"]
    own_s = [trial["processor_seconds"] or 0.0 for trial in trials]
    result = {
        "command": shlex.join(["python", "-m", "tests.bench", "campaign", *sys.argv[1:]]),
        "processor": describe_processor(),
        "rows": sorted({trial["row"] for trial in trials}),
        "kinds": len({trial["name"] for trial in trials}),
        "trials": len(trials),
        "outcomes": Counter(trial["outcome"] for trial in trials),
        "seconds": round(took_s, 1),
        "processor_seconds": round(processor_s, 1),
        "reconstructing_seconds": round(sum(own_s), 1),
        "trials_in_a_core_hour": round(3600.0 * len(trials) / processor_s),
    }
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    say(f"{result['trials_in_a_core_hour']} trials in a core-hour")


def campaign_s(command: list[str]) -> tuple[float, float]:
    """Seconds, and processor seconds with all that it starts. Raises AssertionError where it fails."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    found = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    took_s, after = time.monotonic() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    expect(found.returncode == 0, f"the campaign ended with {found.returncode}: {found.stderr[-800:]}")
    return took_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
