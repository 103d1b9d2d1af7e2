"""What a viewer costs the node: `xvfb-run -s "-screen 0 1280x800x24" python -m tests.bench beside IMAGES`.

The real processes reconstruct a folder of photographs again and again: with no viewer, with one, and with one that was
stopped (SIGSTOP) once its window was open, in turn, so that what else the machine does meets all three alike. Intake is
key frames a second until all are placed, iterations a second are what recon itself says of its refinement. The ratios
are to the run without a viewer in the same round. Wants a quiet machine.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.node import Node, Viewer, processor_s, running
from tests.screen import Screen

CASES = ("alone", "viewer", "stopped viewer")
LOADED_S = 6.0  # recon has imported what it needs by then
OPENED_S = 90.0


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench beside", description=__doc__)
    parser.add_argument("images", type=Path, help="a folder of photographs of one place")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, help="where the figures go, as JSON")
    arguments = parser.parse_args()
    names = sorted(path.name for path in arguments.images.iterdir())
    step = len(names) / arguments.views
    chosen = [names[int(step * number)] for number in range(arguments.views)]
    rounds = []
    for number in range(arguments.rounds):
        order = CASES[number % 3 :] + CASES[: number % 3]
        rounds.append({case: reconstruct(arguments.images, chosen, case) for case in order})
        print(json.dumps(rounds[-1]), flush=True)
    report = {
        "command": f"python -m tests.bench beside {arguments.images.name} --views {arguments.views} "
        f"--rounds {arguments.rounds}",
        "processors": os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "ratios": {
            figure: {
                case: round(statistics.median(one[case][figure] / one["alone"][figure] for one in rounds), 3)
                for case in CASES[1:]
            }
            for figure in ("intake_per_s", "iterations_per_s")
        },
        "rounds": rounds,
    }
    print(json.dumps(report["ratios"], indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


def reconstruct(images: Path, names: list[str], case: str) -> dict[str, float]:
    """The figures of one run of capture and recon."""
    camera = {
        "camera": {"kind": "folder", "folder": str(images.resolve()), "names": names},
        "selection": {"every_frame": True},
    }
    with tempfile.TemporaryDirectory() as folder, running(Node(Path(folder) / "node", camera)) as node:
        recon = node.start("recon")
        shown = None if case == "alone" else open_viewer(node.folder / "recon.yaml")
        try:
            time.sleep(LOADED_S)
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
                raise SystemExit(f"not all frames were placed:\n{node.log('recon')[-2000:]}")
            snapshot = final.snapshot
            return {
                "intake_per_s": len(names) / placed_s,
                "iterations_per_s": snapshot.iterations / snapshot.seconds["optimise"],
                "final_s": time.monotonic() - begun,
                "recon_processor_s": processor_s(recon.pid),
                "viewer_processor_s": processor_s(shown.pid) - viewer_s if shown else 0.0,
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
    while max(screen.pixel(400, 400)) == 0 and viewer.poll() is None and time.monotonic() < deadline:
        time.sleep(0.2)
    return viewer


if __name__ == "__main__":
    main()
