"""What `splatnode.Publisher` costs beside the camera's own path: `python -m tests.bench publisher`.

A walk past a wall, 1280 x 720 at 30 frames a second, already decoded and held in memory, goes to the node in two ways:
as a live camera's frames by `splatnode capture`'s own loop (its reader's thread, selection, spool, previews), and by a
program that calls `publish`. Each runs in a process of its own, in turn, several times; somebody reads the previews and
acknowledges the keyframes. What counts is the processor time of the whole process, as the kernel counts it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import splatnode
from splatnode.capture import daemon
from splatnode.capture.config import Camera, CaptureConfig, PreviewHeader
from splatnode.capture.frame import Frame, wall_clock
from splatnode.capture.image_file import decode_image
from splatnode.capture.messaging.keyframe_queue import KeyframeClient, SpoolConfig
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, CAPTURE_STATUS, Network
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.process.system import keep_freed
from splatnode.capture.status import CaptureStatus
from tests.bench.node.capture import HEIGHT, RATE, WIDTH, write_walk
from tests.support.node import processor_s

HELD = 120  # frames in memory, there and back
WAYS = ("camera", "publisher")
SETTLE_S = 2.0  # that are not counted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each run")
    parser.add_argument("--runs", type=int, default=4, help="of each way, in turn")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--send", nargs=2, metavar=("WAY", "FOLDER"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.send:
        send(args.send[0], Path(args.send[1]))
        return
    spent: dict[str, list[dict[str, float]]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder:
        write_walk(Path(folder, "walk"))
        for run in range(args.runs):
            for way in WAYS if run % 2 == 0 else WAYS[::-1]:
                spent[way].append(measure(way, Path(folder), args.seconds))
    medians = {way: statistics.median(run["ms_a_frame"] for run in runs) for way, runs in spent.items()}
    result = {
        "command": "python -m tests.bench publisher",
        "seconds": args.seconds,
        "frames_per_second": RATE,
        "size": [WIDTH, HEIGHT],
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "runs": spent,
        "median_ms_a_frame": medians,
        "publisher_over_camera": medians["publisher"] / medians["camera"] - 1,
        "load_average": os.getloadavg()[0],
    }
    print(json.dumps(result, indent=1))
    if args.out:
        args.out.write_text(json.dumps(result, indent=1) + "\n")


def measure(way: str, folder: Path, seconds: float) -> dict[str, float]:
    """Processor milliseconds a frame of one run."""
    command = [sys.executable, "-m", "tests.bench", "publisher", "--send", way, str(folder)]
    network = Network(directory=folder / "run")
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            return observe(process.pid, network, seconds)
        finally:
            process.kill()


def observe(pid: int, network: Network, seconds: float) -> dict[str, float]:
    """Acts as recon and as a viewer of the previews, from one heartbeat to another."""
    with (
        KeyframeClient(network) as recon,
        Subscriber(CAPTURE_PREVIEW, network, PreviewHeader) as previews,
        Subscriber(CAPTURE_STATUS, network, CaptureStatus) as heartbeats,
    ):
        beats: list[tuple[CaptureStatus, float, float]] = []
        while not beats or beats[-1][2] - beats[0][2] < seconds:
            previews.latest(0.02)
            if (received := recon.receive(0)) is not None:
                recon.acknowledge(received)
            beat = heartbeats.latest(0)
            if beat is not None and beat.header.frames > SETTLE_S * RATE:
                beats.append((beat.header, processor_s(pid), time.monotonic()))
    (first, used_before, began), (last, used_after, ended) = beats[0], beats[-1]
    frames, used, wall = last.frames - first.frames, used_after - used_before, ended - began
    return {
        "ms_a_frame": 1000 * used / frames,
        "share_of_a_core": used / wall,
        "frames_per_second": frames / wall,
        "keyframes_per_second": (last.keyframes - first.keyframes) / wall,
        "passed_over": float(last.skipped - first.skipped),
    }


def send(way: str, folder: Path) -> None:
    """The process that is measured: sends until it is ended."""
    paths = sorted((folder / "walk").iterdir())[:HELD]
    images = [decode_image(path.read_bytes())[0] for path in paths]
    images += images[::-1]
    places = {"network": {"directory": str(folder / "run")}, "spool": {"directory": str(folder / "state")}}
    cv2.setNumThreads(1)
    keep_freed()
    if way == "camera":
        network, spool = Network(directory=folder / "run"), SpoolConfig(directory=folder / "state")
        daemon.camera_opener = lambda *_: lambda: as_camera(images)
        daemon.is_live = lambda _: True
        daemon.capture(CaptureConfig(Camera("v4l2", None), network=network, spool=spool))
    with splatnode.Publisher(changes=places) as node:
        for image in at_pace(images):
            node.publish(image)


def as_camera(images: list[np.ndarray]) -> Iterator[Frame]:
    for number, image in enumerate(at_pace(images)):
        now_ns = time.monotonic_ns()
        yield Frame(number, f"{now_ns / 1e9:.6f}", now_ns, image, None, captured_at=wall_clock(now_ns))


def at_pace(images: list[np.ndarray]) -> Iterator[np.ndarray]:
    """The images again and again, at the rate of the camera."""
    start, number = time.monotonic(), 0
    while True:
        time.sleep(max(0.0, start + number / RATE - time.monotonic()))
        yield images[number % len(images)]
        number += 1


if __name__ == "__main__":
    main()
