"""How the viewer does on this machine: `python -m tests.bench viewer RESULT` (a folder of `splatnode demo`).

Needs a display; `xvfb-run -s "-screen 0 1280x800x24" python -m tests.bench viewer ...` makes one. Measured are
- pictures per second of 30 000 Gaussians in a window of 1280 x 800, by each engine, as Gaussians and as points, and
  the processor time of one, which other programs disturb less;
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
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from capture.messaging.network import Network
from capture.messaging.services import RECON_SCENE
from capture.messaging.state import StateServer
from capture.messaging.wire import Numbering
from recon.daemon.scene_message import to_message
from recon.export.prepare import SH_C0, take
from recon.picture import take_picture
from tests.bench.rasterize import processor_name
from tests.screen import Screen
from viewer.moment import Moment
from viewer.session import Session
from viewer.sources import Finished, load_result
from viewer.state import Engine, State
from viewer.viewpoint import orbited, scene_pivot

GAUSSIANS = 30_000
WINDOW = 1280, 800
VIEWS = 24  # pictures that are timed
PARTS = ("pictures", "agreement", "live")
PIXEL = 60, 60  # of the screen, where the colour of a scene is looked for: no camera is drawn there
COLOURS = [(1.0, 0.3, 0.5), (0.3, 1.0, 0.5), (0.3, 0.5, 1.0), (0.9, 0.9, 0.2), (0.2, 0.9, 0.9)]  # of scenes, in turn
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
    arguments = parser.parse_args()
    if arguments.child == "pictures":
        print(json.dumps(time_pictures(arguments.result, *CASES[arguments.case])), flush=True)
        os._exit(0)  # Open3D is not asked to take itself down
    if arguments.child == "agreement":
        print(json.dumps(agreement(arguments.result)), flush=True)
        os._exit(0)

    report = {
        "command": f"python -m tests.bench viewer RESULT --minutes {arguments.minutes:g} "
        f"--period-s {arguments.period_s:g} --parts {' '.join(arguments.parts)}",
        "machine": {"processor": processor_name(), "processors": os.cpu_count(), "load_average": os.getloadavg()[0]},
        "gaussians": GAUSSIANS,
        "window": WINDOW,
    }
    if "pictures" in arguments.parts:
        report["pictures"] = {
            f"{engine.name.lower()} {'points' if as_points else 'Gaussians'}": in_child(arguments.result, case)
            for case, (engine, as_points) in enumerate(CASES)
        }
    if "agreement" in arguments.parts:
        report["agreement"] = in_child(arguments.result, None)
    if "live" in arguments.parts:
        report["live"] = watch(arguments.result, arguments.minutes, arguments.period_s)
    report["machine"]["load_average_after"] = os.getloadavg()[0]
    print(json.dumps(report, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


def in_child(result: Path, case: int | None) -> dict:
    """What a process of its own measures: Open3D keeps what it has allocated, and may end the process."""
    what = ["--child", "agreement"] if case is None else ["--child", "pictures", "--case", str(case)]
    command = [sys.executable, "-m", "tests.bench", "viewer", str(result), *what]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    return json.loads(lines[-1]) if lines else {"failed": done.returncode, "said": done.stderr[-500:]}


def thinned(moment: Moment, number: int) -> Moment:
    """The moment with `number` of its Gaussians, chosen by chance."""
    gaussians = moment.snapshot.gaussians
    chosen = np.random.default_rng(0).permutation(len(gaussians))[:number]
    return replace(moment, snapshot=replace(moment.snapshot, gaussians=take(gaussians, np.sort(chosen))))


# ---- Pictures per second ------------------------------------------------------------------------------------------


class TourOver(Exception):
    """Closes the window."""


class Tour(Session):
    """A session whose viewpoint moves at every tick of the window, for VIEWS + 3 ticks."""

    def __init__(self, moment: Moment, state: State) -> None:
        super().__init__(Finished(moment), state)
        self.ticks: list[float] = []
        self.processor: list[float] = []  # seconds of all threads so far

    def receive(self) -> bool:
        self.ticks.append(time.perf_counter())
        self.processor.append(time.process_time())
        if len(self.ticks) > VIEWS + 3:
            raise TourOver
        came = super().receive()
        view = self.grasped()
        if view is not None:
            self.move(orbited(view, 0.02, 0.0))
        return came or view is not None


def time_pictures(result: Path, engine: Engine, as_points: bool) -> dict:
    """Seconds from picture to picture while the viewpoint moves, the first ones left out."""
    from viewer.window import show

    tour = Tour(thinned(load_result(result), GAUSSIANS), State(as_points=as_points))
    with contextlib.suppress(TourOver):
        show(tour, open3d_may_draw=engine is Engine.OPEN3D, screenshots=result, size=WINDOW)
    seconds = np.diff(tour.ticks)[2:]
    processor = (tour.processor[-1] - tour.processor[2]) / (len(tour.processor) - 3)
    return {
        "processor_ms_each": round(1000 * processor, 1),
        "per_second_median": round(1.0 / float(np.median(seconds)), 2),
        "per_second_best": round(1.0 / float(seconds.min()), 2),
        "ms": [round(1000 * one, 1) for one in seconds.tolist()],
    }


# ---- Agreement ----------------------------------------------------------------------------------------------------


def agreement(result: Path) -> dict:
    """Differences between the engines' pictures on black, in levels of 255, at the result's cameras."""
    from open3d.visualization import rendering  # pyright: ignore[reportMissingImports]

    from viewer.scene3d import Scene3D

    moment = load_result(result)
    cameras, gaussians = moment.snapshot.cameras, moment.snapshot.gaussians
    width, height = cameras[0].width, cameras[0].height
    renderer = rendering.OffscreenRenderer(width, height)
    scene = Scene3D(renderer.scene)
    scene.set_drawing(True)
    scene.show_gaussians(gaussians, State())
    renderer.scene.set_background([0.0, 0.0, 0.0, 1.0])
    rows = []
    for camera in cameras:
        extrinsics = np.linalg.inv(camera.T_world_camera)
        renderer.setup_camera(camera.K, extrinsics, width, height)
        theirs = np.asarray(renderer.render_to_image()).astype(float)
        ours = 255.0 * np.clip(take_picture(gaussians, camera.T_world_camera, camera.K, width, height).rgb, 0, 1)
        shifts = {f"{x},{y}": float(np.abs(np.roll(theirs, (y, x), (0, 1)) - ours)[4:-4, 4:-4].mean())
                  for x in (-1, 0, 1) for y in (-1, 0, 1)}  # fmt: skip
        difference = np.abs(theirs - ours)
        rows.append(
            {
                "camera": camera.name,
                "mean": round(float(difference.mean()), 3),
                "share_above_16": round(float((difference.max(2) > 16).mean()), 4),
                "bias": round(float((theirs - ours).mean()), 3),
                "best_shift_px": min(shifts, key=lambda shift: shifts[shift]),
            }
        )
    return {"mean": round(float(np.mean([row["mean"] for row in rows])), 3), "cameras": rows}


# ---- From the node to the screen ----------------------------------------------------------------------------------


def watch(result: Path, minutes: float, period_s: float) -> dict:
    """Latency, memory and processor time of a viewer of a node whose scene changes in size and colour."""
    moment = load_result(result)
    screen, numbering, rng = Screen(), Numbering(), np.random.default_rng(0)
    latencies, memory, sizes, missed = [], [], [], 0
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        config = Path(folder, "node.yaml")
        config.write_text(f"network: {{directory: {folder}}}\n")
        with StateServer(RECON_SCENE, Network(directory=Path(folder))) as server:
            viewer = subprocess.Popen(
                [sys.executable, "-m", "splatnode", "view", str(config)],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            try:
                first = scene_of_colour(moment, 20_000, (1.0, 1.0, 1.0))
                server.publish(*to_message(first.snapshot, "place", numbering.next()))
                wait_for_colour(screen, PIXEL, (1.0, 1.0, 1.0), server, 120.0)
                started, processor = time.monotonic(), processor_seconds(viewer.pid)
                while time.monotonic() - started < 60 * minutes and viewer.poll() is None:
                    begin = time.monotonic()
                    number = int(rng.integers(1000, len(moment.snapshot.gaussians)))
                    colour = COLOURS[len(sizes) % len(COLOURS)]
                    there = scene_of_colour(moment, number, colour)
                    message = to_message(there.snapshot, "place", numbering.next())
                    published = time.monotonic()
                    server.publish(*message)
                    seen = wait_for_colour(screen, PIXEL, colour, server, 10.0)
                    missed += not seen
                    if seen:
                        latencies.append(time.monotonic() - published)
                    sizes.append(number)
                    memory.append(resident_mb(viewer.pid))
                    while time.monotonic() - begin < period_s:
                        server.serve(0.01)
                elapsed = time.monotonic() - started
                processor = processor_seconds(viewer.pid) - processor
                idle = processor_seconds(viewer.pid)
                time.sleep(10.0)
                idle = (processor_seconds(viewer.pid) - idle) / 10.0
            finally:
                alive = viewer.poll() is None
                viewer.terminate()
                code = viewer.wait()
    part = max(1, len(memory) // 20)
    return {
        "updates": len(sizes),
        "not_seen_within_10_s": missed,
        "gaussians": [min(sizes), max(sizes)],
        "latency_ms": {
            f"percentile_{share}": round(1000 * float(np.percentile(latencies, share))) for share in (50, 95, 100)
        },
        "memory_mb": {
            "at_the_end": round(float(np.median(memory[-part:]))),
            "median_of_each_twentieth": [
                round(float(np.median(memory[start : start + part]))) for start in range(0, 20 * part, part)
            ],
        },
        "processor_seconds_per_update": round(processor / len(sizes), 3),
        "processors_taken": round(processor / elapsed, 3),
        "processors_taken_idle": round(idle, 4),
        "alive_at_the_end": alive,
        "exit_status": code,
    }


def scene_of_colour(moment: Moment, number: int, rgb: tuple[float, float, float]) -> Moment:
    """`number` of the Gaussians in one colour, and the first of them so wide and opaque that it fills the window.

    The cameras stay, so that the viewpoint does. Their photographs are as small as can be.
    """
    part = thinned(moment, number)
    gaussians = part.snapshot.gaussians
    sh, means, scales, opacities = (
        np.copy(array)
        for array in (np.zeros_like(gaussians.sh), gaussians.means, gaussians.scales, gaussians.opacities)
    )
    sh[:, 0] = (np.array(rgb) - 0.5) / SH_C0
    means[0], scales[0], opacities[0] = scene_pivot(moment), 4.0, 0.999
    painted = replace(gaussians, means=means, scales=scales, opacities=opacities, sh=sh)
    images = {camera.name: np.zeros((2, 2, 3), np.uint8) for camera in part.snapshot.cameras}
    return replace(part, snapshot=replace(part.snapshot, gaussians=painted, images=images))


def wait_for_colour(screen: Screen, place: tuple[int, int], rgb, server: StateServer, timeout_s: float) -> bool:
    """Whether the pixel takes the colour (RGB in [0, 1]), to 24 levels, in time."""
    deadline = time.monotonic() + timeout_s
    levels = [round(255 * value) for value in rgb]
    while time.monotonic() < deadline:
        if max(abs(a - b) for a, b in zip(screen.pixel(*place), levels, strict=True)) <= 24:
            return True
        server.serve(0.004)
    return False


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def processor_seconds(pid: int) -> float:
    """Of all the process's threads so far."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
