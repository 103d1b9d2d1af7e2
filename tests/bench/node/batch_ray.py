"""A cluster that loses a worker and a machine: `python -m tests.bench batch_ray --windows 100 --built-in 100`.

Two node processes of Ray on this machine, of one core each, beside a head without cores. Two batches run on them, one
after the other, each by a driver of its own:

- `simulated`: the engine, the ledger, the tables and the workers are the real ones; in place of `splatnode replay` a
  shell sleeps for up to a second and then leaves a report, refuses, fails or is killed, at random.
- `real`: windows of three photographs of the real scenes, and the built-in capture with seeds, all of them small,
  reconstructed, and compared to the bit with `splatnode replay` alone, file by file: all but the seconds and the memory
  of the report.

In each, after a third of the recordings a worker is killed with -9 while it works, and after two thirds one of the two
nodes is removed without warning. Counted: rows, how often each simulated recording began, results that are whole, what
is left.
"""

from __future__ import annotations

import argparse
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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.process.terminal import say
from splatnode.extras.batch import LEDGER
from tests.bench.node.batch_simulation import lines, verdict, verdicts
from tests.bench.node.simulated_batch import OUT, TALLY, end_of, recordings
from tests.bench.node.trial import expect
from tests.bench.node.whole_results import as_replayed
from tests.bench.node.windows_on_disk import write_built_in, write_windows
from tests.conftest import ROOT

LONGEST_SLEEP_S = 1.0
_AT_WORK = b"ray::_applied"  # how Ray calls a worker that runs a recording: by the function of extras/jobs/ray.py
_LOOK_EVERY_S = 0.1
_PATIENCE_S = 7200.0
_TRIES = 5  # of a cluster's start: Ray waits 30 s for a node, and the machine may have other work, too
_REPLAY = ("--preset", "preview", "--size", "128")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--simulated", type=int, default=200, help="recordings whose reconstruction is a shell")
    parser.add_argument("--windows", type=int, default=100, help="recordings of three photographs of a real scene")
    parser.add_argument("--built-in", type=int, default=100, help="recordings of the built-in capture, each of a seed")
    parser.add_argument(
        "--compare-s", type=float, default=_PATIENCE_S, help="begin no replay alone after so many seconds"
    )
    parser.add_argument("--scenes", type=Path, default=Path("../shared/scenes"), help="the folder of the real scenes")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/batch_ray.json"))
    args = parser.parse_args()
    result: dict[str, Any] = {"command": shlex.join(["python", "-m", "tests.bench", "batch_ray", *sys.argv[1:]])}
    result |= {"processors": len(os.sched_getaffinity(0)), "ray": importlib.import_module("ray").__version__}
    with tempfile.TemporaryDirectory() as folder:
        result["simulated"] = simulated(Path(folder), args.simulated)
    with tempfile.TemporaryDirectory() as folder:
        write_windows(args.scenes, args.windows, Path(folder) / "in")
        write_built_in(args.built_in, Path(folder) / "in")
        result["real"] = {"windows": args.windows, "built_in": args.built_in, **real(Path(folder), args.compare_s)}
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


def real(folder: Path, compare_s: float) -> dict[str, Any]:
    """Of the recordings in `folder`/in. Raises AssertionError where the batch does not come to its end."""
    names = sorted(path.name for path in (folder / "in").iterdir())
    batch = ("-m", "splatnode", "batch", str(folder / "in"), "--out", str(folder / OUT), *_REPLAY)
    lost = _on_a_cluster(folder, len(names), lambda address: [*batch, "--ray", address])
    began_s = time.monotonic()
    alone = [sys.executable, "-m", "tests.bench.node.replays_alone", str(folder / "in"), str(folder / "alone")]
    subprocess.run([*alone, str(compare_s), *_REPLAY], cwd=ROOT, check=True)
    return {
        "recordings": len(names),
        **lost,
        "seconds_of_replay_alone": round(time.monotonic() - began_s, 1),
        **came_of(folder, names, sorted(path.name for path in (folder / "alone").iterdir())),
    }


def came_of(folder: Path, names: Sequence[str], compared: Sequence[str]) -> dict[str, Any]:
    """Of a batch of recordings of these names; those that are `compared` were replayed alone, too."""
    found = verdicts(folder / OUT)
    other = [name for name in compared if as_replayed(folder / "alone" / name) != as_replayed(folder / OUT / name)]
    return {
        "ledger_lines": lines(folder / OUT / LEDGER),
        "rows": len(found),
        "verdicts": dict(Counter(found.values()).most_common()),
        "with_a_scene": sum((folder / OUT / name / "scene.ply").is_file() for name in names),
        "compared_with_replay_alone": len(compared),
        "the_same_to_the_bit": len(compared) - len(other),
        "others": other,
        **_left(folder / OUT, names),
    }


def _on_a_cluster(folder: Path, count: int, command: Callable[[str], list[str]]) -> dict[str, Any]:
    """Runs a driver on two nodes, and takes a worker and a node from it; what was lost, and when."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])  # of the workers, too
    cluster, nodes = _begun()
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


def _begun() -> tuple[Any, list[Any]]:
    """A cluster, and its two nodes that work. Raises AssertionError."""
    make: Any = importlib.import_module("ray.cluster_utils").Cluster
    for _ in range(_TRIES):
        cluster = make()
        try:
            cluster.add_node(num_cpus=0, include_dashboard=False)
            return cluster, [cluster.add_node(num_cpus=1) for _ in range(2)]
        except Exception as error:  # Ray has no kind of its own for it
            say(f"the cluster has not begun: {error}")
            cluster.shutdown()
    raise AssertionError(f"no cluster has begun in {_TRIES} tries")


def _working() -> list[int]:
    """The workers of this process's cluster that run a recording just now."""
    parents = {int(each.name): _parent(each) for each in Path("/proc").iterdir() if each.name.isdigit()}
    return [pid for pid in parents if _is_below(pid, os.getpid(), parents) and _called(pid).startswith(_AT_WORK)]


def _is_below(pid: int, ancestor: int, parents: Mapping[int, int]) -> bool:
    while pid in parents:
        pid = parents[pid]
        if pid == ancestor:
            return True
    return False


def _parent(process: Path) -> int:
    """0 where it has ended meanwhile."""
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def _called(pid: int) -> bytes:
    try:
        return Path("/proc", str(pid), "cmdline").read_bytes()
    except OSError:  # it has ended meanwhile
        return b""


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


if __name__ == "__main__":
    main()
