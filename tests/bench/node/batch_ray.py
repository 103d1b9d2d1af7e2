"""A cluster that loses a worker and a machine: `python -m tests.bench batch_ray --recordings 200 --real 4`.

Two node processes of Ray on this machine, of one core each, beside a head without cores. Two batches run on them, one
after the other, each by a driver of its own:

- `simulated`: the engine, the ledger, the tables and the workers are the real ones; in place of `splatnode replay` a
  shell sleeps for up to a second and then leaves a report, refuses, fails or is killed, at random.
- `real`: the built-in capture with seeds, reconstructed, and compared to the bit with `splatnode replay` alone.

In each, after a third of the recordings a worker is killed with -9 while it works, and after two thirds one of the two
nodes is removed without warning. Counted: rows, how often each recording began, results that are whole, what is left.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from splatnode.recon.batch.ledger import LEDGER
from tests.bench.node.batch_simulation import lines, verdict, verdicts
from tests.bench.node.simulated_batch import OUT, TALLY, end_of, recordings
from tests.bench.node.trial import expect
from tests.conftest import ROOT

LONGEST_SLEEP_S = 1.0
COMPARED = ("scene.ply", "cameras.json", "sources.bin")
_LOOK_EVERY_S = 0.1
_PATIENCE_S = 3600.0
_REPLAY = ("--preset", "preview")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--real", type=int, default=4)
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/batch_ray.json"))
    args = parser.parse_args()
    result: dict[str, Any] = {"command": shlex.join(["python", "-m", "tests.bench", "batch_ray", *sys.argv[1:]])}
    result |= {"processors": len(os.sched_getaffinity(0)), "ray": importlib.import_module("ray").__version__}
    with tempfile.TemporaryDirectory() as folder:
        result["simulated"] = simulated(Path(folder), args.recordings)
    with tempfile.TemporaryDirectory() as folder:
        result["real"] = real(Path(folder), args.real)
    print(json.dumps(result))
    args.out.write_text(json.dumps(result, indent=1) + "\n")


def simulated(folder: Path, count: int) -> dict[str, Any]:
    """Raises AssertionError where the driver does not come to its end."""
    lost = _on_a_cluster(
        folder,
        count,
        lambda address: [
            *("-m", "tests.bench.node.simulated_batch", str(folder), str(count), address, str(LONGEST_SLEEP_S))
        ],
    )
    began = Counter((folder / TALLY).read_text().split())
    expected = {each.name: end_of(each, LONGEST_SLEEP_S)[0] for each in recordings(folder, count)}
    found = verdicts(folder / OUT)
    return {
        "recordings": count,
        **lost,
        "began": sum(began.values()),
        "repeated": sum(began.values()) - len(began),
        "ledger_lines": lines(folder / OUT / LEDGER),
        "rows": len(found),
        "as_expected": sum(found.get(name) == verdict(end) for name, end in expected.items()),
        **_left(folder / OUT, list(expected)),
    }


def real(folder: Path, count: int) -> dict[str, Any]:
    """Raises AssertionError where a batch or a replay does not come to its end."""
    names = [f"place{seed:02d}" for seed in range(count)]
    for seed, name in enumerate(names):
        (folder / "in" / name).mkdir(parents=True)
        for frame in synthetic.stream(synthetic.Config(seed=seed, views=4, width=320, height=240)):
            (folder / "in" / name / frame.name).write_bytes(encode_png(frame.image))
    batch = ("-m", "splatnode", "batch", str(folder / "in"), "--out", str(folder / OUT), *_REPLAY)
    lost = _on_a_cluster(folder, count, lambda address: [*batch, "--ray", address])
    same = 0
    for name in names:
        alone = [sys.executable, "-m", "splatnode", "replay", str(folder / "in" / name), "--out", str(folder / name)]
        subprocess.run([*alone, *_REPLAY], cwd=ROOT, check=False, capture_output=True)
        same += _digests(folder / name) == _digests(folder / OUT / name)
    return {
        "recordings": count,
        **lost,
        "ledger_lines": lines(folder / OUT / LEDGER),
        "with_a_scene": sum((folder / OUT / name / "scene.ply").is_file() for name in names),
        "the_same_to_the_bit_as_replay_alone": same,
        **_left(folder / OUT, names),
    }


def _on_a_cluster(folder: Path, count: int, command: Callable[[str], list[str]]) -> dict[str, Any]:
    """Runs a driver on two nodes, and takes a worker and a node from it; what was lost, and when."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["PYTHONPATH"] = str(ROOT)  # of the workers, too
    make: Any = importlib.import_module("ray.cluster_utils").Cluster
    cluster = make(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    began_s, lost = time.monotonic(), {}
    try:
        with (folder / "driver.log").open("wb") as log:
            driver = subprocess.Popen([sys.executable, *command(cluster.address)], cwd=ROOT, stdout=log, stderr=log)
        while driver.poll() is None:
            expect(time.monotonic() < began_s + _PATIENCE_S, "the driver does not come to its end")
            rows = lines(folder / OUT / LEDGER)
            if "worker_killed_at_row" not in lost and rows >= count // 3 and (working := _working()):
                os.kill(working[0], signal.SIGKILL)
                lost["worker_killed_at_row"] = rows
            if "node_removed_at_row" not in lost and rows >= 2 * count // 3:
                cluster.remove_node(nodes[1], allow_graceful=False)
                lost["node_removed_at_row"] = rows
            time.sleep(_LOOK_EVERY_S)
        said = (folder / "driver.log").read_text(errors="replace")[-800:]
        expect(driver.wait() in (0, 65), f"exit code {driver.returncode}: {said}")
    finally:
        cluster.shutdown()
    return {**lost, "seconds": round(time.monotonic() - began_s, 1)}


def _working() -> list[int]:
    """The workers of Ray that run a recording just now."""
    found = []
    for process in Path("/proc").iterdir():
        try:
            if process.name.isdigit() and (process / "cmdline").read_bytes().startswith(b"ray::run_recording"):
                found.append(int(process.name))
        except OSError:  # it has ended meanwhile
            continue
    return found


def _left(out: Path, names: Sequence[str]) -> dict[str, Any]:
    whole = {name for name in names if (out / name / "report.json").is_file()}
    folders = {path.name for path in out.iterdir() if path.is_dir()}
    for name in whole:  # half of a report cannot be read
        msgspec.json.decode((out / name / "report.json").read_bytes())
    return {
        "results_whole": len(whole),
        "other_folders": len(folders - whole),
        "hidden_files_left": len(list(out.glob(".*.partial"))),
    }


def _digests(result: Path) -> list[str]:
    return [hashlib.sha256((result / name).read_bytes()).hexdigest() for name in COMPARED if (result / name).is_file()]


if __name__ == "__main__":
    main()
