"""From the node to the screen: how long a scene takes until it is seen, and what the viewer takes for it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import RECON_SCENE, Network
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.recon.result.export.limits import SH_C0, select_gaussians
from splatnode.recon.result.message import encode_snapshot
from splatnode.viewer.sources import load_result
from splatnode.viewer.state import Moment, scene_pivot
from tests.support.node import memory_mb, processor_s
from tests.support.screen import Screen

PIXEL = 130, 110  # of a screen of 1280 x 800, where a scene's colour is looked for: within the window, beside cameras
COLOURS = [(1.0, 0.3, 0.5), (0.3, 1.0, 0.5), (0.3, 0.5, 1.0), (0.9, 0.9, 0.2), (0.2, 0.9, 0.9)]  # of scenes, in turn


def thinned(moment: Moment, number: int) -> Moment:
    """The moment with `number` of its Gaussians, chosen by chance."""
    gaussians = moment.snapshot.gaussians
    chosen = np.random.default_rng(0).permutation(len(gaussians))[:number]
    return replace(moment, snapshot=replace(moment.snapshot, gaussians=select_gaussians(gaussians, np.sort(chosen))))


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
                server.publish(*encode_snapshot(first.snapshot, "place", numbering.next()))
                if not wait_for_colour(screen, PIXEL, (1.0, 1.0, 1.0), server, 120.0):
                    raise SystemExit(
                        f"no scene at {PIXEL} of the screen: is it of 1280 x 800, with the viewer in its middle?"
                    )
                started, processor = time.monotonic(), processor_s(viewer.pid)
                while time.monotonic() - started < 60 * minutes and viewer.poll() is None:
                    begin = time.monotonic()
                    number = int(rng.integers(1000, len(moment.snapshot.gaussians)))
                    colour = COLOURS[len(sizes) % len(COLOURS)]
                    there = scene_of_colour(moment, number, colour)
                    message = encode_snapshot(there.snapshot, "place", numbering.next())
                    published = time.monotonic()
                    server.publish(*message)
                    seen = wait_for_colour(screen, PIXEL, colour, server, 10.0)
                    missed += not seen
                    if seen:
                        latencies.append(time.monotonic() - published)
                    sizes.append(number)
                    memory.append(memory_mb(viewer.pid))
                    while time.monotonic() - begin < period_s:
                        server.serve(0.01)
                elapsed = time.monotonic() - started
                processor = processor_s(viewer.pid) - processor
                idle = processor_s(viewer.pid)
                time.sleep(10.0)
                idle = (processor_s(viewer.pid) - idle) / 10.0
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
