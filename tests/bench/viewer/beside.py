"""What a viewer costs the node: `xvfb-run -s "-screen 0 1280x800x24" python -m tests.bench beside IMAGES`.

The real processes reconstruct a folder of photographs again and again, for some minutes: with no viewer, with one, and
with one that was stopped (SIGSTOP) once its window was open, in turn and in rounds, so that what else the machine does
meets all three alike. Intake is keyframes a second until all are placed, iterations a second are what recon itself
says of its refinement. Each run is compared with the one without a viewer in the same round; said are the median of
these ratios and the rounds' range that holds the true median with at least 90 % confidence, whatever their
distribution. `taken` is the part of the machine's processor time that the viewer took: recon can lose no more to it.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.support.node import Node, Viewer, processor_s, running
from tests.support.screen import Screen

CASES = ("alone", "viewer", "stopped viewer")
RATES = ("intake_per_s", "iterations_per_s", "final_per_s")
CONFIDENCE = 0.9
# How long recon waits for capture in all three cases: the longer any process waits, the more of its memory the machine
# may have taken away, and the later it is through with its first frames.
WAITED_S = 22.0
OPENED_S = WAITED_S - 6.0  # a window that is not there by then would be opening beside the run


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench beside", description=__doc__)
    parser.add_argument("images", type=Path, help="a folder of photographs of one place")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--minutes", type=float, default=10.0, help="no round is begun after them (default: 10)")
    parser.add_argument("--out", type=Path, help="where the figures go, as JSON")
    arguments = parser.parse_args()
    names = sorted(path.name for path in arguments.images.iterdir())
    step = len(names) / arguments.views
    chosen = [names[int(step * number)] for number in range(arguments.views)]
    rounds: list[dict[str, dict[str, float]]] = []
    deadline = time.monotonic() + 60.0 * arguments.minutes
    while time.monotonic() < deadline:
        first = len(rounds) % len(CASES)
        rounds.append({case: reconstruct(arguments.images, chosen, case) for case in CASES[first:] + CASES[:first]})
        print(json.dumps(rounds[-1]), flush=True)
    report = {
        "command": f"python -m tests.bench beside {arguments.images.name} --views {arguments.views} "
        f"--minutes {arguments.minutes:g}",
        "processors": os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "ratios": {
            rate: {case: paired([one[case][rate] / one["alone"][rate] for one in rounds]) for case in CASES[1:]}
            for rate in RATES
        },
        "taken": round(statistics.median(one["viewer"]["taken"] for one in rounds), 4),
        "rounds": rounds,
    }
    print(json.dumps({key: report[key] for key in ("ratios", "taken")}, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


def paired(ratios: list[float]) -> dict[str, object]:
    """The median of the ratios, and between which of them the true one lies with how much confidence.

    Each ratio is above the true median with a chance of one half. So the chance that it lies outside the ones ranked
    `rank` from below and from above is twice that of fewer than `rank` heads in as many throws of a coin.
    """
    ordered, count = sorted(ratios), len(ratios)

    def confidence(rank: int) -> float:
        return 1.0 - 2.0 * sum(math.comb(count, heads) for heads in range(rank)) / 2.0**count

    rank = max((rank for rank in range(1, count // 2 + 1) if confidence(rank) >= CONFIDENCE), default=1)
    return {
        "median": round(statistics.median(ordered), 3),
        "range": [round(ordered[rank - 1], 3), round(ordered[-rank], 3)],
        "confidence": round(confidence(rank), 3),
        "rounds": count,
    }


def reconstruct(images: Path, names: list[str], case: str) -> dict[str, float]:
    """The figures of one run of capture and recon."""
    camera = {
        "camera": {"kind": "folder", "folder": str(images.resolve()), "names": names},
        "selection": {"every_frame": True},
    }
    with tempfile.TemporaryDirectory() as folder, running(Node(Path(folder) / "node", camera)) as node:
        recon, started = node.start("recon"), time.monotonic()
        shown = None if case == "alone" else open_viewer(node.folder / "recon.yaml")
        try:
            time.sleep(max(0.0, started + WAITED_S - time.monotonic()))
            if shown is not None and case == "stopped viewer":
                shown.send_signal(signal.SIGSTOP)
            audience = Viewer(node.network)
            viewer_s = processor_s(shown.pid) if shown else 0.0
            begun = time.monotonic()
            node.start("capture")
            placed = audience.wait(lambda scene: len(scene.snapshot.cameras) == len(names))
            placed_s = time.monotonic() - begun
            final = audience.wait(lambda scene: scene.snapshot.final and len(scene.snapshot.cameras) == len(names))
            audience.close()
            if placed is None or final is None:
                raise SystemExit(f"not all photographs were placed:\n{node.log('recon')[-2000:]}")
            snapshot, final_s = final.snapshot, time.monotonic() - begun
            viewer_s = processor_s(shown.pid) - viewer_s if shown else 0.0
            return {
                "intake_per_s": len(names) / placed_s,
                "iterations_per_s": snapshot.iterations / snapshot.seconds["optimise"],
                "final_per_s": 1.0 / final_s,
                "recon_processor_s": processor_s(recon.pid),
                "viewer_processor_s": viewer_s,
                "taken": viewer_s / (final_s * (os.cpu_count() or 1)),
            }
        finally:
            if shown is not None:
                shown.kill()
                shown.wait()


def open_viewer(config: Path) -> subprocess.Popen:
    """A viewer of the node, when its window is there."""
    screen = Screen()
    viewer = subprocess.Popen(
        [sys.executable, "-m", "splatnode", "view", str(config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + OPENED_S
    while max(screen.pixel(400, 400)) == 0:
        if viewer.poll() is not None or time.monotonic() > deadline:
            viewer.kill()
            viewer.wait()
            raise SystemExit(f"the viewer had no window after {OPENED_S:g} s: is the machine busy?")
        time.sleep(0.2)
    return viewer


if __name__ == "__main__":
    main()
