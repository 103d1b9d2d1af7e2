"""Pictures a second on the screen while the mouse drags the scene, and how soon the splash and the scene are there:
`xvfb-run -s "-screen 0 1280x800x24" python -m tests.bench dragging RESULT`. It needs xdotool.

The result is shown with 40 000 Gaussians: some of its own left out, or some of them twice. Pictures are counted on the
screen, as a person sees them: one that differs from the one before in the upper part of the window.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.limits import select_gaussians
from splatnode.recon.result.export.stored import encode_cameras
from splatnode.viewer.sources import load_result
from tests.bench.speed.rasterize import processor_name
from tests.support.node import processor_s
from tests.support.screen import Screen

GAUSSIANS = 40_000
WINDOW = 1280, 800
WATCHED = 900, 300  # pixels from the top left: of the picture, without the panel
DRAGS, MOVES, MOVE_S = 3, 300, 0.015
SPLASH = 0.5  # standard deviation of the screen's levels once a window is there
SHOWN = 10.0  # levels by which the screen differs from the splash, in the mean, once a scene is there
PATIENCE_S = 120.0


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench dragging", description=__doc__)
    parser.add_argument("result", type=Path, help="a result's folder")
    parser.add_argument("--out", type=Path, help="where the figures go, as JSON")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        write_scene(arguments.result, Path(folder))
        report = {
            "command": 'xvfb-run -s "-screen 0 1280x800x24" python -m tests.bench dragging RESULT',
            "machine": {
                "processor": processor_name(),
                "processors": os.cpu_count(),
                "load_average": os.getloadavg()[0],
            },
            "gaussians": GAUSSIANS,
            "window": WINDOW,
            **watched(Path(folder)),
        }
    report["machine"]["load_average_after"] = os.getloadavg()[0]
    print(json.dumps(report, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


def write_scene(result: Path, folder: Path) -> None:
    """The result with GAUSSIANS Gaussians, and its cameras."""
    snapshot = load_result(result).snapshot
    chosen = np.arange(GAUSSIANS) % len(snapshot.gaussians)
    (folder / "scene.ply").write_bytes(encode_ply(select_gaussians(snapshot.gaussians, np.sort(chosen))))
    (folder / "cameras.json").write_bytes(encode_cameras(snapshot.cameras))


def watched(folder: Path) -> dict:
    """What is seen of a viewer from its start on. Raises SystemExit where no scene comes."""
    screen, started = Screen(), time.monotonic()
    command = [sys.executable, "-m", "splatnode", "view", str(folder), "--size", "x".join(map(str, WINDOW))]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        splash_s = wait_until(screen, lambda picture: picture.std() > SPLASH, started)
        splash = screen.picture(*WINDOW).astype(float)
        scene_s = wait_until(screen, lambda picture: np.abs(picture - splash).mean() > SHOWN, started)
        time.sleep(3.0)
        drags = [dragged(screen, viewer.pid) for _ in range(DRAGS)]
    finally:
        viewer.terminate()
        viewer.wait()
    rates = [drag["pictures_per_s"] for drag in drags]
    return {
        "splash_s": round(splash_s, 2),
        "scene_s": round(scene_s, 2),
        "pictures_per_s": {"median": float(np.median(rates)), "each": rates},
        "longest_wait_ms": [drag["longest_wait_ms"] for drag in drags],
        "processors_taken": [drag["processors_taken"] for drag in drags],
        "processor_ms_each": float(np.median([drag["processor_ms_each"] for drag in drags])),
    }


def wait_until(screen: Screen, there: Callable[[npt.NDArray], bool], started: float) -> float:
    """Seconds until the screen shows what is waited for. Raises SystemExit."""
    while not there(screen.picture(*WINDOW)):
        if time.monotonic() > started + PATIENCE_S:
            raise SystemExit("nothing is shown: is it a display of 1280 x 800 on which a window can be opened?")
        time.sleep(0.02)
    return time.monotonic() - started


def dragged(screen: Screen, pid: int) -> dict:
    """Counts the pictures while the mouse goes back and forth with its left button down."""
    where = [(460 + round(150 * np.sin(step / 20)), 400 + round(60 * np.sin(step / 33))) for step in range(MOVES)]
    path = f" sleep {MOVE_S} ".join(f"mousemove {x} {y}" for x, y in where)
    command = f"mousemove {where[0][0]} {where[0][1]} mousedown 1 {path} mouseup 1"
    mouse = subprocess.Popen(["xdotool", *command.split()])
    seen, before, processor, started = [], screen.picture(*WATCHED), processor_s(pid), time.monotonic()
    while mouse.poll() is None:
        now = screen.picture(*WATCHED)
        if not np.array_equal(now, before):
            seen.append(time.monotonic())
            before = now
        time.sleep(0.004)
    seconds, taken = time.monotonic() - started, processor_s(pid) - processor
    time.sleep(1.0)  # the picture in full, which ends a drag
    return {
        "pictures_per_s": round(len(seen) / seconds, 1),
        "longest_wait_ms": round(1000 * float(np.diff([started, *seen]).max())),
        "processors_taken": round(taken / seconds, 2),
        "processor_ms_each": round(1000 * taken / max(len(seen), 1), 1),
    }


if __name__ == "__main__":
    main()
