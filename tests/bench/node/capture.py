"""What the capture process costs besides decoding: `python -m tests.bench capture --seconds 30 --out capture.json`.

A walk past a wall is written as JPEGs of 1280 x 720 and shown at 30 frames a second; somebody reads the previews and
acknowledges the keyframes. The cost is processor time of the whole process, as the kernel counts it, less the time
that decoding the same files at the same pace takes in this process, in the same minute. Back to back, with its memory
still in the caches, decoding takes less; that figure is told too.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from splatnode.capture.config import PreviewHeader
from splatnode.capture.image_file import decode_image
from splatnode.capture.messaging.keyframe_queue import KeyframeClient
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, CAPTURE_STATUS, Network
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.process.system import keep_freed
from splatnode.capture.status import CaptureStatus
from tests.support.node import processor_s

RATE, WIDTH, HEIGHT = 30, 1280, 720
FRAMES = 480  # so that the wall goes by at an eighth of the picture a second
DECODED = 240  # of them, to know what decoding takes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        photographs = write_walk(Path(folder, "walk"))
        result = {"command": "python -m tests.bench capture", "seconds": args.seconds, "frames_per_second": RATE}
        result |= measure(Path(folder), photographs, args.seconds)
    print(json.dumps(result, indent=1))
    if args.out:
        args.out.write_text(json.dumps(result, indent=1) + "\n")


def write_walk(folder: Path) -> list[Path]:
    """A camera that slides along a textured wall, there and back: new views every few frames, and sensor noise."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    layers = [rng.uniform(0, 80, (HEIGHT // cell, 2 * WIDTH // cell, 3)) for cell in (8, 24, 60)]
    wall = np.sum([cv2.resize(layer, (2 * WIDTH, HEIGHT)) for layer in layers], axis=0)
    for index in range(FRAMES):
        left = int(WIDTH / 2 * (1 - np.cos(2 * np.pi * index / FRAMES)))
        noisy = wall[:, left : left + WIDTH] + rng.normal(0, 1, (HEIGHT, WIDTH, 1))
        image = np.clip(noisy, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{index:04d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return sorted(folder.iterdir())


def measure(folder: Path, photographs: list[Path], seconds: float) -> dict[str, object]:
    config = folder / "capture.yaml"
    config.write_text(
        f"camera: {{kind: folder, folder: {photographs[0].parent}, fps: {RATE}, pace: recorded, "
        "loops: 999}\n"
        f"spool: {{directory: {folder / 'state'}}}\nnetwork: {{directory: {folder / 'run'}}}\n"
    )
    process = subprocess.Popen([sys.executable, "-m", "splatnode", "capture", str(config)], stderr=subprocess.DEVNULL)
    try:
        return observe(process.pid, Network(directory=folder / "run"), photographs, seconds)
    finally:
        process.terminate()
        process.wait()


def observe(pid: int, network: Network, photographs: list[Path], seconds: float) -> dict[str, object]:
    with (
        KeyframeClient(network) as recon,
        Subscriber(CAPTURE_PREVIEW, network, PreviewHeader) as previews,
        Subscriber(CAPTURE_STATUS, network, CaptureStatus) as heartbeats,
    ):
        while previews.latest(1.0) is None:
            pass
        first = heartbeats.latest(5.0)
        used, start, latencies, seen = processor_s(pid), time.monotonic(), [], 0
        newest = first
        while time.monotonic() - start < seconds:
            if (preview := previews.latest(0.02)) is not None:
                latencies.append((time.monotonic_ns() - preview.header.mono_ns) / 1e6)
                seen += 1
            if (received := recon.receive(0)) is not None:
                recon.acknowledge(received)
            newest = heartbeats.latest(0) or newest
        used, wall = processor_s(pid) - used, time.monotonic() - start
    if first is None or newest is None:
        raise RuntimeError("capture has no heartbeat")
    rate = (newest.header.frames - first.header.frames) / ((newest.header.mono_ns - first.header.mono_ns) / 1e9)
    decoding, back_to_back = (decoding_s(photographs[:DECODED], pause) * rate for pause in (1 / rate, 0.0))
    return {
        "frames_per_second_reached": rate,
        "keyframes_per_second": (newest.header.keyframes - first.header.keyframes) / wall,
        "process_share_of_a_core": used / wall,
        "decoding_share_of_a_core": decoding,
        "besides_decoding": used / wall - decoding,
        "decoding_back_to_back": back_to_back,
        "besides_decoding_back_to_back": used / wall - back_to_back,
        "photograph_kb": float(np.median([path.stat().st_size for path in photographs])) / 1000,
        "preview_ms": {str(q): float(np.percentile(latencies, q)) for q in (50, 95, 99)},
        "previews_seen_per_second": seen / wall,
        "rss_mb": newest.header.rss_mb,
        "load_average": os.getloadavg()[0],
    }


def decoding_s(photographs: list[Path], pause_s: float) -> float:
    """Median processor seconds to read and decode one of the files, with pauses in between."""
    keep_freed()  # as capture does
    spent = []
    for path in photographs:
        time.sleep(pause_s)
        start = time.thread_time()
        decode_image(path.read_bytes(), 1 << 30)
        spent.append(time.thread_time() - start)
    return float(np.median(spent))


if __name__ == "__main__":
    main()
