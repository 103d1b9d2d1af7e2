"""How the viewer does on this machine: `python -m tests.bench viewer RESULT` (a folder of `splatnode demo`).

Needs a display; `xvfb-run -s "-screen 0 1280x800x24" python -m tests.bench viewer ...` makes one. Measured are
- pictures per second of 30 000 Gaussians in a window of the size that it has here, by each engine, as Gaussians and as
  points, and the processor time of one, which other programs disturb less;
- how far apart the pictures of Open3D and of the project's own rasteriser are, at the cameras of the result;
- the time from the publication of a scene until its colour is on the screen, read back from the X server, and the
  viewer's memory, while scenes grow and shrink at random for some minutes;
- the processor time that the viewer takes in that time, which is the most that it can slow a node down.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from splatnode.viewer.probe import probe_window
from splatnode.viewer.session import Session
from splatnode.viewer.sources import FixedSource, load_result
from splatnode.viewer.state import Engine, Moment, ViewerState, orbit
from tests.bench.speed.rasterize import processor_name
from tests.bench.viewer.agreement import agreement
from tests.bench.viewer.watching import thinned, watch

GAUSSIANS = 30_000
VIEWS = 24  # pictures that are timed
PARTS = ("pictures", "agreement", "live")
CASES = [(engine, as_points) for engine in Engine for as_points in (False, True)]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench viewer", description=__doc__)
    parser.add_argument("result", type=Path, help="a result's folder")
    parser.add_argument("--minutes", type=float, default=5.0, help="of scenes that grow and shrink")
    parser.add_argument("--period-s", type=float, default=1.0, help="between those scenes")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure (default: all)")
    parser.add_argument("--out", type=Path, help="where the figures go, as JSON")
    parser.add_argument("--child", choices=("pictures", "agreement"), help="used by this program itself")
    parser.add_argument("--case", type=int, default=0, help="used by this program itself")
    parser.add_argument("--window", type=int, nargs=2, help="used by this program itself")
    arguments = parser.parse_args()
    if arguments.child == "pictures":
        print(json.dumps(time_pictures(arguments.result, *CASES[arguments.case], arguments.window)), flush=True)
        os._exit(0)  # Open3D is not asked to take itself down
    if arguments.child == "agreement":
        print(json.dumps(agreement(arguments.result)), flush=True)
        os._exit(0)

    window = probe_window().size
    report = {
        "command": f"python -m tests.bench viewer RESULT --minutes {arguments.minutes:g} "
        f"--period-s {arguments.period_s:g} --parts {' '.join(arguments.parts)}",
        "machine": {"processor": processor_name(), "processors": os.cpu_count(), "load_average": os.getloadavg()[0]},
        "gaussians": GAUSSIANS,
        "window": window,
    }
    if "pictures" in arguments.parts:
        report["pictures"] = {
            f"{engine.name.lower()} {'points' if as_points else 'Gaussians'}": in_child(
                arguments.result, "pictures", "--case", str(case), "--window", *map(str, window)
            )
            for case, (engine, as_points) in enumerate(CASES)
        }
    if "agreement" in arguments.parts:
        report["agreement"] = in_child(arguments.result, "agreement")
    if "live" in arguments.parts:
        report["live"] = watch(arguments.result, arguments.minutes, arguments.period_s)
    report["machine"]["load_average_after"] = os.getloadavg()[0]
    print(json.dumps(report, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


def in_child(result: Path, *what: str) -> dict:
    """What a process of its own measures: Open3D keeps what it has allocated, and may end the process."""
    command = [sys.executable, "-m", "tests.bench", "viewer", str(result), "--child", *what]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    return json.loads(lines[-1]) if lines else {"failed": done.returncode, "said": done.stderr[-500:]}


class TourOver(Exception):
    """Closes the window."""


class Tour(Session):
    """A session whose viewpoint moves at every tick of the window, for VIEWS + 3 ticks."""

    def __init__(self, moment: Moment, state: ViewerState) -> None:
        super().__init__(FixedSource(moment), state)
        self.ticks: list[float] = []
        self.processor: list[float] = []  # seconds of all threads so far

    def receive(self) -> bool:
        self.ticks.append(time.perf_counter())
        self.processor.append(time.process_time())
        if len(self.ticks) > VIEWS + 3:
            raise TourOver
        came = super().receive()
        view = self.viewpoint_to_move()
        if view is not None:
            self.move(orbit(view, 0.02, 0.0))
        return came or view is not None


def time_pictures(result: Path, engine: Engine, as_points: bool, window: tuple[int, int]) -> dict:
    """Seconds from picture to picture while the viewpoint moves, the first ones left out."""
    from splatnode.viewer.window import show

    tour = Tour(thinned(load_result(result), GAUSSIANS), ViewerState(as_points=as_points))
    with contextlib.suppress(TourOver):
        show(tour, software=engine is Engine.CORE, screenshots=result, size=window)
    seconds = np.diff(tour.ticks)[2:]
    processor = (tour.processor[-1] - tour.processor[2]) / (len(tour.processor) - 3)
    return {
        "processor_ms_each": round(1000 * processor, 1),
        "per_second_median": round(1.0 / float(np.median(seconds)), 2),
        "per_second_best": round(1.0 / float(seconds.min()), 2),
        "ms": [round(1000 * one, 1) for one in seconds.tolist()],
    }


if __name__ == "__main__":
    main()
